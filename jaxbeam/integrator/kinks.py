"""Passages of wheels with mass over kinks: points at which the slope of their path jumps.

The slope of a beam jumps at a hinge and, if it is flexible in shear, where the shear force or the
shear stiffness does; that of a profile at the ends of a ramp. A wheel that stays on the surface
then changes its velocity by |v| ([w'] + [r']) at once, from left to right; see `with_impulses`.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.case.beam import has
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.layout import kink_nodes
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.transfer_matrices import has_settlement
from jaxbeam.numerics.polynomials import slope_jumps
from jaxbeam.runtime.arrays import Array, Module, take, xp


class KinkSteps(Module):
    """Kink passages among steps (`here`), and the jumps of velocity under the wheels in them.

    `slopes` are rows from q to |v| [w'], `profile` is |v| [r'] (m/s); zero for other wheels.
    """

    here: Bool[Array, " step"]
    slopes: Float[Array, "step load mode"]
    profile: Float[Array, "step load"]


class KinkPassages(Module):
    """Passages of wheels over kinks: times (s; `NEVER` if there is none), indices of the wheels.

    `slope_jumps` are rows from the coordinates q to the jump [w'] of the slope of the beam,
    `profile_jumps` the jumps of the slope of the profile (1), from left to right.
    """

    times: Float[Array, " passage"]
    wheels: Int[Array, " passage"]
    slope_jumps: Float[Array, "passage mode"]
    profile_jumps: Float[Array, " passage"]

    def of_steps(
        self,
        passage: Int[Array, " step"],
        loads: Int[Array, "step load"],
        on_beam: Bool[Array, "step load"],
        speed: Float[Array, "step load"],
    ) -> "KinkSteps":
        """Kink passages and velocity jumps of steps, from the index of the passage (-1 for none).

        `loads` are the indices of the wheels in each step, `speed` (m/s) is at its start.
        """
        here, which = passage >= 0, xp.maximum(passage, 0)
        passing = here[:, None] & on_beam & (loads == take(self.wheels, which)[:, None])
        speed = xp.where(passing, xp.abs(speed), 0.0)
        slopes = speed[..., None] * take(self.slope_jumps, which)[:, None]
        return KinkSteps(here, slopes, speed * take(self.profile_jumps, which)[:, None])

    def happen(
        self, windows: Float[Array, "wheel 2"], start: Float[Array, ""], end: Float[Array, ""]
    ) -> Bool[Array, " passage"]:
        """Whether each passage is between two times (s), with the wheel on the beam on both sides.

        `windows` are the times of entry and exit of all wheels.
        """
        entry, leave = take(windows, self.wheels).T
        return (self.times > xp.maximum(entry, start)) & (self.times < leave) & (self.times <= end)


def kink_passages(
    case: Case, model: ModalModel, loads: LoadSet | None = None
) -> KinkPassages | None:
    """Passages over all kinks of the wheels that may have mass; None without kinks or such wheels.

    `loads` are those of the case, computed unless they are given.
    """
    nodes = np.array(kink_nodes(case, model.modes.layout), int)
    if model.modes.rail_series is not None:  # a rail has no kinks
        nodes = nodes[:0]
    if not (nodes.size or case.profile is not None or has_settlement(case)):
        return None
    wheels = np.flatnonzero(np.concatenate([np.zeros(0, bool), *map(_has_mass, case.loads)]))
    if not wheels.size:
        return None
    loads = load_set(case, model.modes.layout) if loads is None else loads
    positions, profile_jumps = model.modes.nodes[nodes], xp.zeros(nodes.size)
    rows = slope_jumps(model.modes.nodes, model.modes.series)[nodes - 1]
    rows = rows if model.mode_map is None else rows @ model.mode_map
    if loads.profile is not None:
        more, jumps = loads.profile.slope_kinks()
        positions = xp.concatenate([positions, more])
        profile_jumps = xp.concatenate([profile_jumps, jumps])
        rows = xp.concatenate([rows, xp.zeros((jumps.shape[0], rows.shape[1]))])
    if not positions.shape[0]:
        return None
    # A wheel that stops on a kink does not pass it.
    times, rest = loads.passages(positions)[wheels], loads.rest_times()[wheels][:, None]
    return KinkPassages(
        xp.where(times < rest, times, NEVER).reshape(-1),
        np.repeat(wheels, positions.shape[0]),
        xp.tile(rows, (wheels.size, 1)),
        xp.tile(profile_jumps, wheels.size),
    )


def may_have_kinks(case: Case) -> bool:
    """Whether a wheel with mass may pass a kink of the beam; profiles are left out."""
    beam = case.beam
    sheared = has(beam, "shear_stiffness") and (case.supports or beam.segments)
    return bool(beam.hinges or sheared) and any(np.any(_has_mass(load)) for load in case.loads)


def _has_mass(load: AbstractLoad) -> Bool[np.ndarray, " wheel"]:
    """Whether each wheel of a load may have mass that is rigidly on the surface."""
    masses = load.vehicle(np.ones(())).wheel_masses
    values = np.asarray(concrete(masses)) if is_concrete(masses) else np.ones(masses.shape)
    return np.tile(values != 0, load.spacings().shape[0])
