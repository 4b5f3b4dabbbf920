"""Commands from law to beam: compensation, limits, delay, then hysteresis and creep.

And limits of the voltages that inner loops set. A loop asks for the voltage v, a linear function of
states and command; the coil gets clip(v). What is missing, clip(v) - v, is one more command of the
linear model: it acts on the coil, and takes the integral of the loop back to where clip(v) is (see
`jaxbeam.case.actuators.electrodynamic`).
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.actuators.base import limited_loops
from jaxbeam.case.actuators.hysteresis import Creep, Hysteresis
from jaxbeam.case.case import Case
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensor_signals import ROUNDED
from jaxbeam.numerics.polynomials import lagrange_weights
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    is_jax,
    not_differentiated,
    set_at,
    stop_gradient,
    take,
    xp,
)
from jaxbeam.simulation.integrator.discrete_model import NODE_COUNT

CommandRanges = tuple[Float[Array, " actuator"], ...]


def command_ranges(case: Case) -> CommandRanges:
    """Lowest and highest command and rate limit (1/s) of each actuator; infinite without one."""
    limits = [actuator.command_limits() for actuator in case.actuators]
    rates = [actuator.command_rate_limit() for actuator in case.actuators]
    low = xp.array([-xp.inf if pair is None else pair[0] for pair in limits])
    high = xp.array([xp.inf if pair is None else pair[1] for pair in limits])
    return low, high, xp.array([xp.inf if rate is None else rate for rate in rates])


def acting_ranges(case: Case) -> CommandRanges:
    """Bounds of the commands that act, behind hysteresis and creep, and of their rates (1/s)."""
    low, high, rate = command_ranges(case)
    actuators = case.actuators
    if all(one.hysteresis is None and one.creep is None for one in actuators):
        return low, high, rate
    creeps = xp.stack([xp.ones(()) if a.creep is None else a.creep.final_gain for a in actuators])

    def acts(ends):
        """Commands that act in the end under steady commands at these ends of the ranges."""
        return creeps * xp.stack(
            [
                end
                if a.hysteresis is None
                else xp.where(xp.isinf(end), end, a.hysteresis.first_output(end))
                for end, a in zip(ends, actuators, strict=True)
            ]
        )

    slopes = [
        xp.ones(()) if a.hysteresis is None else xp.sum(a.hysteresis.weights) for a in actuators
    ]
    return acts(low), acts(high), rate * creeps * xp.stack(slopes)


def limit_commands(
    case: Case,
    commands: Float[Array, "actuator *batch"],
    previous: Float[Array, "actuator *batch"] | None = None,
    ranges: CommandRanges | None = None,
) -> Float[Array, "actuator *batch"]:
    """Commands rounded to the resolution of the controller, then limited by each actuator.

    Rate limits apply over a sampling period from the `previous` commands. `ranges` are what
    `command_ranges` returns, computed again if left out. Derivatives ignore the rounding; those by
    the resolution raise ValueError.
    """
    controller = case.controller
    if controller.resolution is not None:
        step = not_differentiated(controller.resolution, ROUNDED)
        rounded = step * xp.round(commands / step)
        commands = commands + stop_gradient(rounded - commands)
    low, high, rate = (
        part.reshape(-1, *[1] * (commands.ndim - 1)) for part in ranges or command_ranges(case)
    )
    commands = xp.clip(commands, low, high)
    if previous is not None and any(a.command_rate_limit() is not None for a in case.actuators):
        change = rate * controller.period
        commands = xp.clip(commands, previous - change, previous + change)
    return commands


State = Float[Array, "state batch"]
Command = Float[Array, " batch"]


class CommandOperator(Module):
    """Hysteresis, then creep: operator from commands held for a period (s) to commands that act.

    The state has the plays, the first of which is the command itself, and the lags at the start of
    the period.
    """

    hysteresis: Hysteresis
    creep: Creep | None
    period: Float[Array, ""]

    def start(self, batch_size: int) -> State:
        """State at rest."""
        lags = 0 if self.creep is None else self.creep.rates.shape[0]
        return xp.zeros((self.hysteresis.thresholds.shape[0] + lags, batch_size))

    def follow(self, state: State, command: Command) -> State:
        """State in the period of a new command, from the state in the period before."""
        plays, lags = self._parts(state)
        followed = self.hysteresis.follow(plays, command)
        if self.creep is None:
            return followed
        lags = self.creep.after(lags, self.hysteresis.output(plays), self.period)
        return xp.concatenate([followed, lags])

    def output(self, state: State) -> Command:
        """Command that acts, its mean over the period."""
        plays, lags = self._parts(state)
        at_once = self.hysteresis.output(plays)
        if self.creep is None:
            return at_once
        of_command, of_lags = self.creep.mean_factors(self.period)
        return of_command * at_once + xp.tensordot(of_lags, lags, axes=1)

    def inverse(self) -> "InverseOperator":
        """Inverse operator: from the command that is to act to the command to send."""
        return InverseOperator(self.hysteresis.inverse(), self.creep, self.period)

    def _parts(self, state):
        count = self.hysteresis.thresholds.shape[0]
        return state[:count], state[count:]


class InverseOperator(Module):
    """Inverse of a `CommandOperator`; `hysteresis` is the inverse of that of the operator.

    The lags follow from past commands, so that y = s v + sum of s_i z_i has the solution v, the
    command that is to act at once.
    """

    hysteresis: Hysteresis
    creep: Creep | None
    period: Float[Array, ""]

    def start(self, batch_size: int) -> State:
        """State at rest."""
        return CommandOperator(self.hysteresis, self.creep, self.period).start(batch_size)

    def follow(self, state: State, wanted: Command) -> State:
        """State in the period of a new wanted command, from the state in the period before."""
        if self.creep is None:
            return self.hysteresis.follow(state, wanted)
        count = self.hysteresis.thresholds.shape[0]
        # The first threshold is zero: its play is the last command that acted at once.
        lags = self.creep.after(state[count:], state[0], self.period)
        of_command, of_lags = self.creep.mean_factors(self.period)
        at_once = (wanted - xp.tensordot(of_lags, lags, axes=1)) / of_command
        return xp.concatenate([self.hysteresis.follow(state[:count], at_once), lags])

    def output(self, state: State) -> Command:
        """Command to be sent."""
        return self.hysteresis.output(state[: self.hysteresis.thresholds.shape[0]])


def command_operator(
    hysteresis: Hysteresis | None, creep: Creep | None, period: Float[Array, ""]
) -> CommandOperator | None:
    """Operator of an actuator; None where it has neither hysteresis nor creep."""
    if hysteresis is None and creep is None:
        return None
    if hysteresis is None:
        hysteresis = Hysteresis(xp.zeros(1), xp.ones(1))
    return CommandOperator(hysteresis, creep, period)


Commands = Float[Array, "actuator batch"]
Queue = Float[Array, "age actuator batch"]


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
    """Path of the commands of a case: compensations, ranges, and operators of the actuators."""

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

    def assumed_commands(self, memory: CommandMemory, age=None) -> Commands:
        """Commands that act according to the compensations, as a law for linear actuators assumes.

        The present ones; with an `age`, those sent so many commands ago, whether they arrived or
        not.
        """
        if age is not None:
            return take(memory.queue if memory.assumed is None else memory.assumed_queue, age)
        return memory.command if memory.assumed is None else memory.assumed

    def send(self, memory: CommandMemory, wanted: Commands) -> CommandMemory:
        """Memory with the compensated and limited command for a wanted one in the queue."""
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
            if not is_jax(age):
                return queue[age] if age >= 0 else last
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
    """Path of the commands of a case from law to beam."""
    period = case.controller.period
    operators = tuple(command_operator(a.hysteresis, a.creep, period) for a in case.actuators)
    compensations = tuple(
        command_operator(a.compensation, a.creep_compensation, period) for a in case.actuators
    )
    inverses = tuple(None if one is None else one.inverse() for one in compensations)
    return CommandPath(case, command_ranges(case), operators, compensations, inverses)


def with_exact_compensation(case: Case) -> Case:
    """The case with its hysteresis and creep compensated exactly, so that wanted commands act."""
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


POINTS = 128  # within a step, at which voltages are compared with their limits
_FRACTIONS = (np.arange(POINTS) + 0.5) / POINTS
TO_POINTS = lagrange_weights(NODE_COUNT, _FRACTIONS)
FROM_POINTS = np.linalg.pinv(TO_POINTS)


class VoltageLimits(Module):
    """Limits (V) of coils, and rows from the states of a plant and from commands to voltages."""

    low: Float[Array, " coil"]
    high: Float[Array, " coil"]
    of_states: Float[Array, "coil state"]
    of_commands: Float[Array, "coil actuator"]

    def asked(
        self, state: Float[Array, "all *batch"], command: Float[Array, "actuator *batch"]
    ) -> Float[Array, "coil *batch"]:
        """Voltages (V) that the loops ask for; states after those of the plant do not count."""
        return self.of_states @ state[: self.of_states.shape[1]] + self.of_commands @ command

    def missing(self, asked: Float[Array, "node coil batch"]) -> Float[Array, "node coil batch"]:
        """Voltages (V) missing to those asked for, from Gauss nodes to Gauss nodes of a step.

        Where a limit is passed within the step, the polynomial through the nodes with the least
        square of its distance, whose effect at the end of the step is that of the voltages.
        """
        low, high = self.low[:, None], self.high[:, None]
        within = xp.tensordot(TO_POINTS, asked, axes=1)
        return xp.tensordot(FROM_POINTS, xp.clip(within, low, high) - within, axes=1)


def with_missing_voltages(
    case: Case, plant: ModalModel, model: ModalModel
) -> tuple[ModalModel, VoltageLimits | None]:
    """Model whose last commands are missing voltages (V), and their limits; None without limits.

    `plant` is the modal model of the case, `model` the same with states and commands added.
    """
    coils = limited_loops(case.actuators)
    if not coils:
        return model, None
    sizes = [actuator.attachment().state_matrix.shape[0] for actuator in case.actuators]
    starts = 2 * plant.mode_count + np.cumsum([0, *sizes])
    of_states = xp.zeros((len(coils), plant.state_count))
    of_commands = xp.zeros((len(coils), len(case.actuators)))
    columns = xp.zeros((model.state_count, len(coils)))
    for row, i in enumerate(coils):
        port, own = case.actuators[i].coil_port(), np.arange(starts[i], starts[i + 1])
        shape, (on_s, on_rate, _) = plant.displacement_map[i], port.voltage.port
        coordinates, rates = (np.arange(k, 2 * plant.mode_count, 2) for k in (0, 1))
        of_states = set_at(of_states, (row, coordinates), on_s * shape)
        of_states = set_at(of_states, (row, rates), on_rate * shape)
        of_states = set_at(of_states, (row, own), port.voltage.states)
        of_commands = set_at(of_commands, (row, i), port.voltage.command)
        columns = set_at(columns, (own, row), port.on_missing)
    low, high = (xp.stack([case.actuators[i].limits[end] for i in coils]) for end in (0, 1))
    commands = xp.concatenate([model.command_matrix, columns], axis=1)
    limited = eqx.tree_at(lambda m: m.command_matrix, model, commands)
    return limited, VoltageLimits(low, high, of_states, of_commands)
