"""Commands of a run that are known at its events, held in between."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.integrator.input_policy import AbstractInputPolicy
from jaxbeam.integrator.propagators import NODE_COUNT
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.arrays import Array, cond, take, xp


class HeldCommands(AbstractInputPolicy):
    """Input policy of commands that begin at the events of a schedule, as those of an earlier run.

    At the nodes of a step each command is the same: (node and actuator) of a row.
    """

    model: ModalModel
    commands: Float[Array, "event command batch"]
    load_amplitude: Float[Array, " batch"]
    holds_commands: ClassVar[bool] = True
    implicit: ClassVar[bool] = False

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
