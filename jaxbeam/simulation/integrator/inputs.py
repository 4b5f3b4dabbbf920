"""Input policies: commands to the actuators during a run, and how loops that diverge are found.

Divergence is seen in the growth of the motion and not in its size. A loop that is unstable grows
exponentially, a bounded motion at most as a power of time while it starts. So the largest amplitude
of the modes is compared at the end of the run, at half, a quarter, an eighth of it, and so on: the
run diverges if it has grown by more than GROWTH from one of these times to the next, and once more
to the one after that. Neither unit nor size matters. Amplitudes below the static one of all loads
at once are raised to it, as loads may enter late.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.arrays import Array, Module, any_jax, cond, stop_gradient, take, xp
from jaxbeam.simulation.integrator.time_grid import TimeGrid


class StepInfo(NamedTuple):
    """Start (s) and length (s) of a step or several, and index of the event at the start.

    `event` is -1 for a step that starts between two events of the schedule.
    """

    start: Float[Array, " *step"]
    length: Float[Array, " *step"]
    event: Int[Array, " *step"]


class AbstractInputPolicy(Module):
    """Commands to the actuators of a run as a function of the state.

    With `implicit`, commands depend on the states at the Gauss nodes of the step. `load_amplitude`
    is the least amplitude at which growth counts as divergence (see the module), infinite for
    commands that do not depend on the state.
    """

    implicit: eqx.AbstractVar[bool]
    load_amplitude: eqx.AbstractVar[Float[Array, "*batch"]]

    def acts_at(self, events: Int[np.ndarray, " step"]) -> Bool[np.ndarray, " step"]:
        """Whether commands, memory or observations may change at events; negative where is none."""
        return np.ones(events.shape, bool)

    @abc.abstractmethod
    def start(self, batch_size: int) -> Any:
        """Memory of the policy at the start of a batch of runs, of any structure."""

    @abc.abstractmethod
    def inputs(
        self, memory, state: Float[Array, "state batch"], info: StepInfo, states
    ) -> tuple[Float[Array, "node actuator batch"], Any]:
        """Commands (node, actuator, batch) of a step from this state, and the memory after it.

        If `implicit`, `states` maps commands to the states at the nodes (node, state, batch).
        """

    def of_time(self, infos: StepInfo) -> Float[Array, "*step node actuator"] | None:
        """Commands of a step, or of several, if they depend on time alone; else None."""
        return None

    @abc.abstractmethod
    def observe(self, memory, info: StepInfo) -> Any:
        """Values to be saved at the start of a step with an event, batch axis last, or None."""


class HeldCommands(AbstractInputPolicy):
    """Input policy of given commands, held between events, as the commands of an earlier run.

    A row of `commands` has them at each node of a step and actuator; all nodes have the same.
    """

    model: ModalModel
    commands: Float[Array, "event command batch"]
    load_amplitude: Float[Array, " batch"]
    implicit: ClassVar[bool] = False

    def acts_at(self, events):
        return events >= 0

    def start(self, batch_size):
        return xp.zeros(self.commands.shape[1:])

    def inputs(self, memory, state, info, states):
        memory = cond(
            info.event >= 0,
            lambda memory: take(self.commands, info.event),
            lambda memory: memory,
            memory,
        )
        actuators = self.model.command_matrix.shape[1]
        return memory.reshape(-1, actuators, memory.shape[-1]), memory

    def observe(self, memory, info):
        return None


GROWTH = 100.0  # a motion that starts from rest as the sixth power of time grows 64-fold
MARK_COUNT = 12  # times at which amplitudes are compared
OVERFLOW = 1e100  # larger states become NaN, as their squares would overflow soon; in any unit
ELASTIC = 1e-9  # relative to the unit of stiffness; less is rigid-body motion


def load_amplitude(case, model: ModalModel, loads: LoadSet) -> Float[Array, " batch"]:
    """Amplitude (see `amplitudes`) of the static response to all loads at once, in runs of a batch.

    Mode shapes are at most of the order 2 / sqrt(mass).
    """
    times = case.run.duration * np.linspace(0.0, 1.0, 33)
    weight = xp.sum(xp.abs(loads.varying_weight(times)), axis=1)
    stiffness = model.modes.stiffness
    elastic = stiffness > ELASTIC * model.modes.stiffness_unit
    compliance = xp.sum(xp.where(elastic, 1 / xp.where(elastic, stiffness, 1.0), 0.0))
    shape_square = 4 / (case.beam.linear_density * case.beam.length)
    return xp.max(weight, axis=0) * xp.sqrt(shape_square * compliance)


def has_feedback(policy) -> bool:
    """Whether commands may depend on the state; True where a traced amplitude leaves it open."""
    return any_jax(policy.load_amplitude) or bool(np.any(np.isfinite(policy.load_amplitude)))


def growth_marks(grid: TimeGrid) -> Float[Array, " mark"]:
    """Times (s) at which amplitudes are compared: the end, half of it, and so on."""
    return grid.boundaries[-1] * 0.5 ** np.arange(MARK_COUNT)


def amplitudes(
    model: ModalModel, states: Float[Array, "time state batch"]
) -> Float[Array, "time batch"]:
    """Root of the sum of q'^2 + k q^2 over the modes, (time, batch); infinite where it is NaN."""
    stiffness = xp.diagonal(model.stiffness())[:, None]
    q, rates = states[:, model.coordinate_index], states[:, model.rate_index]
    root = xp.sqrt(xp.sum(rates**2 + xp.abs(stiffness) * q**2, axis=1))
    return xp.where(xp.isnan(root), xp.inf, root)


def largest_by_marks(
    marks: Float[Array, " mark"],
    times: Float[Array, " time"],
    amplitude: Float[Array, "time batch"],
) -> Float[Array, "mark batch"]:
    """Largest amplitude up to each mark (s)."""
    before = times[:, None, None] <= marks[:, None]
    return xp.max(xp.where(before, amplitude[:, None], 0.0), axis=0)


def growth_limit(
    largest: Float[Array, "mark batch"], least: Float[Array, " batch"]
) -> Float[Array, " batch"]:
    """Amplitude beyond which a run has diverged; infinite for one that is bounded."""
    now, before, earlier = largest[:-2], largest[1:-1], largest[2:]
    grown = (now > GROWTH * before) & (before > GROWTH * xp.maximum(earlier, least))
    return xp.min(xp.where(grown & (before > 0), GROWTH * before, xp.inf), axis=0)


def diverged(
    model: ModalModel,
    grid: TimeGrid,
    states: Float[Array, "boundary state batch"],
    times: Float[Array, " boundary"],
    least: Float[Array, " batch"],
) -> Bool[Array, "boundary batch"]:
    """Whether a run has diverged by each boundary of its steps."""
    amplitude = stop_gradient(amplitudes(model, states))
    limit = growth_limit(largest_by_marks(growth_marks(grid), times, amplitude), least)
    return xp.cumsum(amplitude > limit, axis=0) > 0
