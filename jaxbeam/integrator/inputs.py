"""Input policies: commands to the actuators during a run, computed or given beforehand."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.integrator.propagators import NODE_COUNT
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.arrays import Array, Module, cond, take, xp


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
    is the least amplitude at which growth counts as divergence (see `growth`), infinite for
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
        return memory.reshape(NODE_COUNT, -1, memory.shape[-1]), memory

    def observe(self, memory, info):
        return None
