"""Way of the commands of a sampled law to the beam: inverse hysteresis, limits, delay, hysteresis.

A law asks for a command that acts on a linear actuator. Where the actuator has a `compensation`,
the inverse of that operator gives the command to be sent; it is rounded and limited, begins after
the delay, and acts through the `hysteresis` of the actuator.
"""

import dataclasses
from typing import NamedTuple

from jaxtyping import Float

from jaxbeam.case.actuators.hysteresis import Hysteresis
from jaxbeam.case.case import Case
from jaxbeam.runtime.arrays import Array, take, xp
from jaxbeam.runtime.module import Module
from jaxbeam.simulation.commands.limits import CommandRanges, command_ranges, limit_commands

Commands = Float[Array, "actuator batch"]
Queue = Float[Array, "age actuator batch"]
Plays = Float[Array, "play batch"]


class CommandMemory(NamedTuple):
    """Present command, those that have not begun yet (newest first), plays of the hysteresis.

    `assumed` are the commands that act according to the compensations, with their queue, their
    plays, and those of their inverses; None without compensations. Plays are those of each
    actuator, None where it has no such operator.
    """

    command: Commands
    queue: Queue
    plays: tuple[Plays | None, ...]
    assumed: Commands | None
    assumed_queue: Queue | None
    assumed_plays: tuple[Plays | None, ...]
    inverse_plays: tuple[Plays | None, ...]


class CommandPath(Module):
    """Operators of the actuators and the ranges of their commands."""

    case: Case
    ranges: CommandRanges
    hysteresis: tuple[Hysteresis | None, ...]
    compensation: tuple[Hysteresis | None, ...]
    inverses: tuple[Hysteresis | None, ...]

    def start(self, batch_size: int, max_waiting: int) -> CommandMemory:
        """Memory at the start of a run."""
        command = xp.zeros((len(self.case.actuators), batch_size))
        queue = xp.zeros((max_waiting + 1, *command.shape))
        compensated = any(one is not None for one in self.compensation)

        def at_rest(operators):
            return tuple(
                None if one is None else xp.zeros((one.thresholds.shape[0], batch_size))
                for one in operators
            )

        return CommandMemory(
            command,
            queue,
            at_rest(self.hysteresis),
            command if compensated else None,
            queue if compensated else None,
            at_rest(self.compensation),
            at_rest(self.inverses),
        )

    def acting(self, memory: CommandMemory) -> Commands:
        """Commands that act on the beam."""
        return _outputs(self.hysteresis, memory.plays, memory.command)

    def known_to_law(self, memory: CommandMemory) -> Commands:
        """Present commands as a law of linear actuators knows them."""
        return memory.command if memory.assumed is None else memory.assumed

    def send(self, memory: CommandMemory, wanted: Commands) -> CommandMemory:
        """Memory with the command for a wanted one in the queue."""
        plays = _follow(self.inverses, memory.inverse_plays, wanted)
        command = _outputs(self.inverses, plays, wanted)
        command = limit_commands(self.case, command, memory.queue[0], self.ranges)
        memory = memory._replace(queue=_pushed(command, memory.queue))
        if memory.assumed is None:
            return memory
        assumed_plays = _follow(self.compensation, memory.assumed_plays, command)
        assumed = _outputs(self.compensation, assumed_plays, command)
        return memory._replace(
            assumed_queue=_pushed(assumed, memory.assumed_queue),
            assumed_plays=assumed_plays,
            inverse_plays=_follow(self.inverses, memory.inverse_plays, assumed),
        )

    def begin(self, memory: CommandMemory, age) -> CommandMemory:
        """Memory after the command of an age in the queue begins; none where it is negative."""

        def present(queue, last):
            return xp.where(age >= 0, take(queue, xp.maximum(age, 0)), last)

        command, assumed = present(memory.queue, memory.command), memory.assumed
        if assumed is not None:
            assumed = present(memory.assumed_queue, assumed)
        plays = _follow(self.hysteresis, memory.plays, command)
        return memory._replace(command=command, plays=plays, assumed=assumed)


def command_path(case: Case) -> CommandPath:
    """Way of the commands of a case."""
    compensation = tuple(actuator.compensation for actuator in case.actuators)
    return CommandPath(
        case,
        command_ranges(case),
        tuple(actuator.hysteresis for actuator in case.actuators),
        compensation,
        tuple(None if one is None else one.inverse() for one in compensation),
    )


def with_exact_compensation(case: Case) -> Case:
    """The case whose hystereses are compensated exactly, so that wanted commands act."""
    actuators = tuple(
        actuator
        if actuator.hysteresis is None
        else dataclasses.replace(actuator, compensation=actuator.hysteresis)
        for actuator in case.actuators
    )
    return dataclasses.replace(case, actuators=actuators)


def _pushed(commands: Commands, queue: Queue) -> Queue:
    return xp.concatenate([commands[None], queue[:-1]])


def _follow(operators, plays, commands):
    """Plays of the operators after their commands."""
    return tuple(
        None if one is None else one.follow(each, command)
        for one, each, command in zip(operators, plays, commands, strict=True)
    )


def _outputs(operators, plays, commands) -> Commands:
    """Outputs of the operators; commands of actuators without one are unchanged."""
    if all(one is None for one in operators):
        return commands
    return xp.stack(
        [
            command if one is None else one.output(each)
            for one, each, command in zip(operators, plays, commands, strict=True)
        ]
    )
