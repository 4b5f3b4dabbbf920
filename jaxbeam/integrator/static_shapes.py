"""Static shapes of a case: data other than numbers on which compiled code depends."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.integrator.integrate import longest_force_step, max_stable_step
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel, has_coupling, modal_model
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.compiling import compiled_if_traced


@dataclasses.dataclass(frozen=True)
class StaticShapes:
    """Static data that fix array shapes.

    Layout of supports and patches, coupling of modes, largest number of loads on the beam at once;
    and whether runs without an input policy are integrated in C (`native`).
    """

    layout: Layout
    coupled: bool
    max_loads: int
    native: bool = False


def static_shapes(case: Case) -> StaticShapes:
    """Static shapes of a case with concrete numbers (not inside `jit`)."""
    case = concrete_case(case)
    layout = mesh_layout(case)
    _, repeated, entry_exit = model_limits(case, layout)
    return StaticShapes(
        layout, has_coupling(case) or bool(repeated), max_concurrent_loads(np.asarray(entry_exit))
    )


@compiled_if_traced
def model_limits(case: Case, layout: Layout):
    """Longest stable step (s), whether frequencies repeat, entry and exit times (load, 2) in s."""
    model, loads = modal_model(case, layout), load_set(case, layout)
    limit = longest_stable_step(case, model, loads)
    return limit, model.modes.has_repeated, loads.entry_exit_times()


def longest_stable_step(case: Case, model: ModalModel, loads: LoadSet) -> Float[Array, ""]:
    """Longest step (s) that is stable and resolves the passages of forces."""
    return xp.minimum(max_stable_step(model, loads), longest_force_step(case, loads))


def max_concurrent_loads(entry_exit_times: Float[np.ndarray, "load 2"]) -> int:
    """Largest number of loads on the beam at once; at least one if there are any."""
    entries, exits = entry_exit_times.T
    # The number increases only when a load enters.
    on_beam = (entries[None, :] <= entries[:, None]) & (entries[:, None] < exits[None, :])
    return max(min(1, entries.size), int(np.max(on_beam.sum(axis=1), initial=0)))
