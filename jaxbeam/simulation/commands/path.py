"""Way of the commands of a sampled law to the beam: inverse operator, limits, delay, operator.

A law asks for a command that acts on a linear actuator. Where the actuator has a `compensation` of
its hysteresis or creep, the inverse of that operator gives the command to be sent; it is rounded
and limited, begins after the delay, and acts through `hysteresis` and `creep` of the actuator.
"""

import dataclasses
from typing import NamedTuple

from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.runtime.arrays import Array, take, xp
from jaxbeam.runtime.module import Module
from jaxbeam.simulation.commands.limits import CommandRanges, command_ranges, limit_commands
from jaxbeam.simulation.commands.operators import (
    CommandOperator,
    InverseOperator,
    command_operator,
)

Commands = Float[Array, "actuator batch"]
Queue = Float[Array, "age actuator batch"]
State = Float[Array, "state batch"]


class CommandMemory(NamedTuple):
    """Present command, those that have not begun yet (newest first), states of the operators.

    `assumed` are the commands that act according to the compensations, with their queue, their
    states, and those of their inverses; None without compensations. States are those of each
    actuator, None where it has no such operator.
    """

    command: Commands
    queue: Queue
    states: tuple[State | None, ...]
    assumed: Commands | None
    assumed_queue: Queue | None
    assumed_states: tuple[State | None, ...]
    inverse_states: tuple[State | None, ...]


class CommandPath(Module):
    """Operators of the actuators and the ranges of their commands."""

    case: Case
    ranges: CommandRanges
    operators: tuple[CommandOperator | None, ...]
    compensations: tuple[CommandOperator | None, ...]
    inverses: tuple[InverseOperator | None, ...]

    def start(self, batch_size: int, max_waiting: int) -> CommandMemory:
        """Memory at the start of a run."""
        command = xp.zeros((len(self.case.actuators), batch_size))
        queue = xp.zeros((max_waiting + 1, *command.shape))
        compensated = any(one is not None for one in self.compensations)

        def at_rest(operators):
            return tuple(None if one is None else one.start(batch_size) for one in operators)

        return CommandMemory(
            command,
            queue,
            at_rest(self.operators),
            command if compensated else None,
            queue if compensated else None,
            at_rest(self.compensations),
            at_rest(self.inverses),
        )

    def acting(self, memory: CommandMemory) -> Commands:
        """Commands that act on the beam."""
        return _outputs(self.operators, memory.states, memory.command)

    def known_to_law(self, memory: CommandMemory, age=None) -> Commands:
        """Present commands as a law of linear actuators knows them.

        With an `age`, those made so many commands ago, whether they arrived or not.
        """
        if age is not None:
            return take(memory.queue if memory.assumed is None else memory.assumed_queue, age)
        return memory.command if memory.assumed is None else memory.assumed

    def send(self, memory: CommandMemory, wanted: Commands) -> CommandMemory:
        """Memory with the command for a wanted one in the queue."""
        states = _follow(self.inverses, memory.inverse_states, wanted)
        command = _outputs(self.inverses, states, wanted)
        command = limit_commands(self.case, command, memory.queue[0], self.ranges)
        memory = memory._replace(queue=_pushed(command, memory.queue))
        if memory.assumed is None:
            return memory
        assumed_states = _follow(self.compensations, memory.assumed_states, command)
        assumed = _outputs(self.compensations, assumed_states, command)
        return memory._replace(
            assumed_queue=_pushed(assumed, memory.assumed_queue),
            assumed_states=assumed_states,
            inverse_states=_follow(self.inverses, memory.inverse_states, assumed),
        )

    def begin(self, memory: CommandMemory, age) -> CommandMemory:
        """Memory after the command of an age in the queue begins; none where it is negative."""

        def present(queue, last):
            return xp.where(age >= 0, take(queue, xp.maximum(age, 0)), last)

        command, assumed = present(memory.queue, memory.command), memory.assumed
        if assumed is not None:
            assumed = present(memory.assumed_queue, assumed)
        followed = _follow(self.operators, memory.states, command)
        states = tuple(
            None if new is None else xp.where(age >= 0, new, old)
            for new, old in zip(followed, memory.states, strict=True)
        )
        return memory._replace(command=command, states=states, assumed=assumed)


def command_path(case: Case) -> CommandPath:
    """Way of the commands of a case."""
    period = case.controller.period
    operators = tuple(command_operator(a.hysteresis, a.creep, period) for a in case.actuators)
    compensations = tuple(
        command_operator(a.compensation, a.creep_compensation, period) for a in case.actuators
    )
    inverses = tuple(None if one is None else one.inverse() for one in compensations)
    return CommandPath(case, command_ranges(case), operators, compensations, inverses)


def with_exact_compensation(case: Case) -> Case:
    """The case whose hystereses and creep are compensated exactly, so that wanted commands act."""
    actuators = tuple(
        actuator
        if actuator.hysteresis is None and actuator.creep is None
        else dataclasses.replace(
            actuator, compensation=actuator.hysteresis, creep_compensation=actuator.creep
        )
        for actuator in case.actuators
    )
    return dataclasses.replace(case, actuators=actuators)


def _pushed(commands: Commands, queue: Queue) -> Queue:
    return xp.concatenate([commands[None], queue[:-1]])


def _follow(operators, states, commands):
    """States of the operators after their commands."""
    return tuple(
        None if one is None else one.follow(each, command)
        for one, each, command in zip(operators, states, commands, strict=True)
    )


def _outputs(operators, states, commands) -> Commands:
    """Outputs of the operators; commands of actuators without one are unchanged."""
    if all(one is None for one in operators):
        return commands
    return xp.stack(
        [
            command if one is None else one.output(each)
            for one, each, command in zip(operators, states, commands, strict=True)
        ]
    )
