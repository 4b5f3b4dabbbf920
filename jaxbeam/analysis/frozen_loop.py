"""Dynamics of the loop opened at the commands, as affine functions of its state.

The state holds plant with sensor filters and vehicles, states of law and digital filters, and the
queues of delayed readings and commands. Limits, ranges and resolution are left out.
"""

import functools
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import (
    AbstractContinuousLaw,
    AbstractSampledLaw,
    Measurement,
)
from jaxbeam.case.sensors import filter_step
from jaxbeam.case.trajectory import NEVER, AbstractTrajectory
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import compiled_modal_model
from jaxbeam.model.modes import Layout
from jaxbeam.model.sensor_signals import (
    initial_filter_state,
    sensor_sections,
    with_sensor_filters,
)
from jaxbeam.model.state_space import Plant, StateSpace, build_plant
from jaxbeam.numerics.stages import propagate
from jaxbeam.runtime.arrays import Array, Module, any_jax, ravel_pytree, to_numpy, xp
from jaxbeam.runtime.compiling import compiled_if_traced

STEP = 2.0**20  # of each argument; exact in floating point, and far above the value at zero
TRIAL_SIZES = 1e-6, 1.0, 1e6  # of random arguments at which an affine function is one
AFFINE_ROUNDING = 1e-9  # relative


class NotAffineError(ValueError):
    """Error of a function that is not affine, so that its derivatives need JAX."""


def affine_jacobian(
    function: Callable, point: Float[Array, " argument"]
) -> Float[Array, "value argument"]:
    """Jacobian of a function (argument,) -> (value,) at a point, without JAX if it is affine.

    At a traced point by JAX. At a concrete one by differences, which are exact for an affine
    function. Raises NotAffineError for any other function, and for one that computes with JAX.
    """
    start = function(np.zeros(point.shape))
    if any_jax(point, start):
        if any_jax(point) or isinstance(start, jax.core.Tracer):
            return jax.jacfwd(function)(point)
        raise NotAffineError
    size = point.shape[0]
    if not start.size:
        none: Any = np.zeros((0, size))
        return none
    with np.errstate(all="ignore"):
        columns: list[Any] = [(function(STEP * unit) - start) / STEP for unit in np.eye(size)]
        matrix: Any = np.stack(columns, axis=1) if size else np.zeros((start.shape[0], 0))
        if not all(is_affine(function, matrix, start, scale) for scale in TRIAL_SIZES):
            raise NotAffineError
    return matrix


def is_affine(
    function: Callable,
    matrix: Float[np.ndarray, "value argument"],
    start: Float[np.ndarray, " value"],
    scale: float = 1.0,
) -> bool:
    """Whether a function is the affine one start + matrix @ argument, tried at a random argument.

    Two affine functions that agree there are the same, within rounding.
    """
    trial = scale * random_argument(matrix.shape[1])
    terms = np.abs(matrix) @ np.abs(trial) + np.abs(start)
    return bool(np.all(np.abs(function(trial) - start - matrix @ trial) <= AFFINE_ROUNDING * terms))


@functools.cache
def random_argument(size: int) -> Float[np.ndarray, " argument"]:
    """Random argument from a normal distribution, of a fixed seed."""
    return np.random.default_rng(0).standard_normal(size)


def apply(
    matrix: Float[Array, "*time after before"], values: Float[Array, "before *column"]
) -> Float[Array, "after *column"]:
    """Product of a matrix and a vector or columns; of one matrix for each time, and the columns of
    the first time, those of the second and so on."""
    if matrix.ndim == 2:
        return matrix @ values
    groups = values.reshape(values.shape[0], matrix.shape[0], -1)
    products = matrix @ xp.moveaxis(groups, 1, 0)
    return xp.moveaxis(products, 0, 1).reshape(matrix.shape[1], -1)


PERIOD_TOLERANCE = 1e-9  # of a period; smaller differences of times count as zero


class LoopTiming(NamedTuple):
    """Sampling period, delay of the commands and delays of the sensors (s) of a loop."""

    period: float
    delay: float
    sensor_delays: tuple[float, ...]


class FrozenTrajectory(AbstractTrajectory):
    """Trajectory of a frozen load, with constant position, speed and acceleration."""

    position: Float[Array, ""]
    speed: Float[Array, ""]
    acceleration: Float[Array, ""]
    heading: Float[Array, ""]
    on_beam: Any
    length: Float[Array, ""]

    def direction(self):
        return self.heading

    def kinematics(self, t):
        shape = xp.shape(t)
        parts = self.position, self.speed, self.acceleration
        return tuple(xp.broadcast_to(part, shape) for part in parts)

    def entry_exit_times(self, behind=0.0):
        entry = xp.where(self.on_beam, -NEVER, NEVER)
        return entry, xp.full(entry.shape, NEVER)

    def passage_times(self, positions, behind=0.0):
        return xp.zeros(0)


class LoopDynamics(Module):
    """Plant with sensor filters, and control law, as functions of their states.

    `augmented_plant` has the analogue filters of the sensors as further states; `output_rows` map
    its states to the inputs of the sensors.
    """

    plant: Plant
    augmented_plant: Plant
    output_rows: Float[Array, "sensor state"]
    law: AbstractSampledLaw | AbstractContinuousLaw

    def freeze_loads(self, t) -> "LoopDynamics":
        """The same dynamics with loads frozen at t (s)."""
        frozen = frozen_loads(self.augmented_plant.loads, self.plant.case.beam.length, t)
        return eqx.tree_at(lambda loop: loop.augmented_plant.loads, self, frozen)

    def continuous_dynamics(self, t, system: StateSpace | None = None):
        """A, B, rates due to the weights, and the function from state to commands, at t (s).

        The last states are those of the law, about their values at the start of a run. `system` is
        the augmented plant at that time, computed if left out.
        """
        system = self.augmented_plant.at(t) if system is None else system
        command_count = len(self.plant.case.actuators)
        size, zero_command = system.A.shape[0], xp.zeros(command_count)

        def measure(state):
            # Sensors are ideal in continuous time; outputs of the law's filters follow.
            inner, own = state[:size], state[size:]
            readings = self._sensor_inputs(inner, zero_command, t)
            return own, self._measurement(readings, inner, zero_command)

        def command(state):
            return self.law.command(*measure(state), t)

        def rates(state, given):
            return self.law.rates(*measure(state), given, t)

        controller_states = self.law.state_count
        zero_state = xp.zeros(size + controller_states)
        jacobian = affine_jacobian(
            lambda both: rates(both[: len(zero_state)], both[len(zero_state) :]),
            xp.zeros(len(zero_state) + command_count),
        )
        controller_rows, controller_inputs = xp.split(jacobian, [len(zero_state)], axis=1)
        A = xp.concatenate([xp.pad(system.A, ((0, 0), (0, controller_states))), controller_rows])
        input_matrix = xp.concatenate([system.B[:, :command_count], controller_inputs])
        weight_rates = xp.append(
            system.B[:, command_count:] @ self.augmented_plant.weights,
            rates(zero_state, zero_command),
        )
        return A, input_matrix, weight_rates, command

    def rest_state(self, timing: LoopTiming):
        """State of the sampled loop at rest as one vector, and the function that unpacks it."""
        case = self.plant.case
        filters = [
            initial_filter_state(sensor, sensor_sections(sensor, timing.period), xp.zeros(()))
            for sensor in case.sensors
        ]
        signal_history = [
            xp.zeros(_split_delay(lag / timing.period)[2]) for lag in timing.sensor_delays
        ]
        command_queue = xp.zeros(
            (_split_delay(timing.delay / timing.period)[0] + 1, len(case.actuators))
        )
        plant = self.augmented_plant
        state = xp.zeros(plant.modal_model.state_count + plant.vehicle_states)
        return ravel_pytree(
            (
                state,
                filters,
                signal_history,
                self.law.initial_state(),
                command_queue,
            )
        )

    def plant_transitions(
        self, timing: LoopTiming, t, substeps: int | None = None, weights: bool = True
    ) -> list:
        """Transition matrices from state, commands and weights to the state, for parts of a period.

        The period begins at t (s), one time or several. Loads are frozen there, or move, in
        `substeps` of each part. Matrices of deviations have no `weights`.
        """
        system = self.augmented_plant.at(t)
        states, commands = system.A.shape[-1], len(self.plant.case.actuators)
        inputs = system.B.shape[-1] if weights else commands

        def augmented_matrix(time):
            # Held inputs as further states.
            now = system if substeps is None else self.augmented_plant.at(time)
            top = xp.concatenate([now.A, now.B[..., :inputs]], axis=-1)
            return xp.pad(top, [*[(0, 0)] * (top.ndim - 2), (0, inputs), (0, 0)])

        identity = xp.broadcast_to(xp.eye(states + inputs), (*xp.shape(t), *[states + inputs] * 2))
        return [
            propagate(augmented_matrix, t + start, end - start, substeps or 1, identity)[
                ..., :states, :
            ]
            for start, end in _intervals(timing)
        ]

    def sampling_step(self, timing: LoopTiming, state, t, transitions, command_given=None):
        """State just before the next sample, from that just before a sample at t (s), and commands.

        `transitions` are those of the plant over the period, of its state and inputs, or of its
        deviations, without the weights. `command_given` replaces the commands of the law. All may
        be columns (entry, column) if the law takes them, the same number of each of several times.
        """
        plant_state, filters, signal_history, law_state, command_queue = state
        case, signal_history, states, readings = self.plant.case, list(signal_history), [], []
        whole_periods, fraction, _ = _split_delay(timing.delay / timing.period)
        signals = self._sensor_inputs(plant_state, command_queue[whole_periods], t)
        delayed_samples = {}
        for i, sensor in enumerate(case.sensors):
            whole, remainder, history_length = _split_delay(timing.sensor_delays[i] / timing.period)
            if remainder:
                delayed_samples.setdefault((1 - remainder) * timing.period, []).append(i)
            else:
                signal_history[i] = xp.concatenate([signals[i : i + 1], signal_history[i]])
            sections = sensor_sections(sensor, timing.period)
            # An ideal sensor, without range, resolution and offset.
            reading, after = signal_history[i][whole], None
            if sections is not None:
                reading, after = filter_step(sections, filters[i], reading)
            readings.append(reading)
            states.append(after)
            signal_history[i] = signal_history[i][:history_length]
        readings = xp.stack(readings) if readings else xp.zeros((0, *plant_state.shape[1:]))
        measurement = self._measurement(readings, plant_state, command_queue[whole_periods])
        controller_command, law_state, _ = self.law.step(law_state, measurement, t)
        command_queue = xp.concatenate(
            [(controller_command if command_given is None else command_given)[None], command_queue]
        )
        # Within the period the command changes once, and delayed sensors take their samples.
        change = fraction * timing.period
        for (_, end), transition in zip(_intervals(timing), transitions, strict=True):
            command = command_queue[whole_periods + (end <= change)]
            inputs = self._inputs(command)[: transition.shape[-1] - plant_state.shape[0]]
            plant_state = apply(transition, xp.concatenate([plant_state, inputs]))
            for i in delayed_samples.get(end, ()):
                signal = self._sensor_inputs(plant_state, command, t + end)[i : i + 1]
                signal_history[i] = xp.concatenate([signal, signal_history[i]])[
                    : signal_history[i].shape[0]
                ]
        return (
            plant_state,
            states,
            signal_history,
            law_state,
            command_queue[: whole_periods + 1],
        ), controller_command

    def _sensor_inputs(self, state, command, t):
        """Inputs of the sensors (sensor,) after their analogue filters."""
        beam = state[: self.output_rows.shape[1]]
        signals = self.output_rows @ self.augmented_plant.to_modal(beam)
        has_feedthrough = np.array([s.has_feedthrough for s in self.plant.case.sensors], bool)
        if not has_feedthrough.any():
            return signals
        system = self.augmented_plant.at(t)
        accelerations = apply(system.C, state) + apply(system.D, self._inputs(command))
        has_feedthrough = has_feedthrough.reshape(-1, *(1,) * (signals.ndim - 1))
        return xp.where(has_feedthrough, accelerations, signals)

    def _inputs(self, command):
        """Commands, then the weights; columns of both for columns of commands."""
        weights = self.augmented_plant.weights
        weights = weights.reshape(-1, *(1,) * (command.ndim - 1))
        return xp.concatenate(
            [command, xp.broadcast_to(weights, (*weights.shape[:1], *command.shape[1:]))]
        )

    def _measurement(self, readings, state, command):
        beam = state[: self.output_rows.shape[1]]
        model_state = self.augmented_plant.to_modal(beam)[: self.plant.modal_model.state_count]
        return Measurement(readings, self.plant.from_modal(model_state), command)


def loop_dynamics(case: Case, layout: Layout) -> LoopDynamics:
    """Loop dynamics of a case that has a controller; may be traced and batched."""
    return to_numpy(_loop_dynamics(case, compiled_modal_model(case, layout)))


@compiled_if_traced
def _loop_dynamics(case, model):
    plant = build_plant(case, model)
    law = case.controller.law(plant)
    filters = law.filters if case.controller.period is None else ()
    augmented_model, output_rows = with_sensor_filters(plant, filters)
    augmented_plant = eqx.tree_at(lambda m: m.modal_model, plant, augmented_model)
    return LoopDynamics(plant, augmented_plant, output_rows, law)


def frozen_loads(loads: LoadSet, length, t) -> LoadSet:
    """Loads frozen at t (s) on a beam of a length (m)."""
    counts = [behind.shape[0] for behind in loads.behind]
    on = xp.split(loads.on_beam(t), np.cumsum(counts)[:-1]) if counts else []
    trajectories = tuple(
        FrozenTrajectory(*path.kinematics(t), path.direction(), on_beam, length)
        for path, on_beam in zip(loads.trajectories, on, strict=True)
    )
    return eqx.tree_at(lambda loads: loads.trajectories, loads, trajectories)


def _intervals(timing: LoopTiming) -> list[tuple[float, float]]:
    """Start and end (s) of the intervals of a period with a constant command, between samples."""
    fraction = _split_delay(timing.delay / timing.period)[1]
    remainders = (_split_delay(lag / timing.period)[1] for lag in timing.sensor_delays)
    samples = ((1 - remainder) * timing.period for remainder in remainders if remainder)
    changes = {0.0, fraction * timing.period, *samples, timing.period}
    return list(itertools.pairwise(sorted(changes)))


def _split_delay(periods: float) -> tuple[int, float, int]:
    """Whole periods of a delay, the remaining fraction, and the number of periods it spans."""
    whole = math.floor(periods + PERIOD_TOLERANCE)
    remainder = max(periods - whole, 0.0)
    remainder = remainder if remainder > PERIOD_TOLERANCE else 0.0
    return whole, remainder, whole + (remainder > 0)
