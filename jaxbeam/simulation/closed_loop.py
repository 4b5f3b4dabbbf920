"""The closed loop: sensors, controller and actuators' limits, as the driver of the integrator.

A controller with a sampling period acts at its ticks, on the readings it has by then; its command
begins a delay later and is held, while the beam moves continuously in between. A controller
without a period acts at every instant: its law is demanded at the Gauss nodes of each step, by
Newton's method, beside the contact law.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import Measurement
from jaxbeam.case.fields import concrete
from jaxbeam.integrator.events import EventSchedule, controller_schedule
from jaxbeam.integrator.input_policy import AbstractInputPolicy, StepInfo
from jaxbeam.integrator.propagators import GAUSS_NODES, NODE_COUNT
from jaxbeam.model.contact import LoadSet, contact_at
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Layout
from jaxbeam.model.output_rows import sensor_rows
from jaxbeam.model.sensor_filters import with_sensor_filters
from jaxbeam.model.sensor_signals import (
    filtered_reading,
    initial_filter_state,
    noise_samples,
    sensor_sections,
)
from jaxbeam.model.state_space import Plant, state_space

NEWTON_ITERATIONS = (
    4  # of Newton's method for a law at every instant; one would do for a linear law
)


def loop_schedule(case: Case, samples: Float[np.ndarray, " time"]) -> EventSchedule:
    """When the controller of a case acts and its sensors are read, up to the last sample (s)."""
    controller, end = case.controller, samples[-1]
    breakpoints = controller.breakpoints(case)
    breakpoints = np.zeros(0) if breakpoints is None else concrete(breakpoints)
    if controller.period is None:
        return controller_schedule(samples, np.zeros(0), 0.0, [], [], breakpoints)

    def clock(period):
        return np.arange(int(np.floor(end / period * (1 + 1e-12))) + 1) * period

    period = float(concrete(controller.period))
    sampling_periods = [
        period if s.sampling_period is None else concrete(s.sampling_period) for s in case.sensors
    ]
    delays = [0.0 if s.delay is None else float(concrete(s.delay)) for s in case.sensors]
    delay = 0.0 if controller.delay is None else float(concrete(controller.delay))
    return controller_schedule(
        samples,
        clock(period),
        delay,
        [clock(float(p)) for p in sampling_periods],
        delays,
        breakpoints,
    )


class ClosedLoop(AbstractInputPolicy):
    """The driver made of the controller of a case. Lanes share the controller, not its memory.

    `initial_memory` is that memory at the start, which holds what the controller works out beforehand.
    So many states of a law that acts at every instant are `controller_states`: they are the last of the
    rig's, and their rates the last of the commands.
    """

    plant: Plant
    initial_memory: Any
    model: ModalModel
    output_rows: Float[Array, "sensor state"]
    loads: LoadSet
    schedule: EventSchedule
    filter_sections: tuple
    noise: Float[Array, "read sensor"] | None
    state_bound: Float[Array, " state"]
    implicit: bool = eqx.field(static=True)
    controller_states: int = eqx.field(static=True)

    def start(self, batch_size: int) -> Any:
        controller, case = self.plant.case.controller, self.plant.case
        memory = _broadcast_to_batch(self.initial_memory, batch_size)
        if controller.period is None:
            return memory, jnp.zeros((self.model.command_matrix.shape[1], batch_size))
        commands = jnp.zeros((len(case.actuators), batch_size))
        pairs = zip(case.sensors, self.filter_sections, strict=True)
        sensor_memory = [
            initial_filter_state(sensor, sections, jnp.zeros(batch_size))
            for sensor, sections in pairs
        ]
        readings_at_rest = [
            filtered_reading(sensor, sections, state, jnp.zeros(batch_size))[0]
            for sensor, sections, state in zip(
                case.sensors, self.filter_sections, sensor_memory, strict=True
            )
        ]
        readings_at_rest = (
            jnp.stack(readings_at_rest) if readings_at_rest else jnp.zeros((0, batch_size))
        )
        reading_history = jnp.broadcast_to(
            readings_at_rest, (self.schedule.max_age + 1, *readings_at_rest.shape)
        )
        command_queue = jnp.zeros((self.schedule.max_waiting + 1, *commands.shape))
        return memory, commands, sensor_memory, reading_history, command_queue

    def inputs(self, memory, state, step_info: StepInfo, states):
        if self.plant.case.controller.period is None:
            return self._continuous_inputs(memory, state, step_info, states)
        memory = jax.lax.cond(
            step_info.event >= 0,
            lambda memory: self._process_event(memory, state, step_info),
            lambda memory: memory,
            memory,
        )
        command = memory[1]
        return jnp.broadcast_to(command, (NODE_COUNT, *command.shape)), memory

    def _continuous_inputs(self, memory, state, step_info: StepInfo, states):
        controller_memory, last_command = memory
        times = step_info.start + step_info.length * GAUSS_NODES
        if not self.implicit:
            commands = jax.vmap(lambda time: self._control_law(controller_memory, state, time))(
                times
            )
            return commands, (controller_memory, commands[-1])

        def commands_for(commands):
            return jax.vmap(lambda *at: self._control_law(controller_memory, *at))(
                states(commands), times
            )

        guess = jnp.broadcast_to(last_command, (NODE_COUNT, *last_command.shape))
        commands = newton_fixed_point(commands_for, guess, NEWTON_ITERATIONS)
        return commands, (controller_memory, commands[-1])

    def commands_at(self, states: Float[Array, "time state"], times: Float[Array, " time"]):
        """Commands (time, command) of a law at every instant, for a single lane.

        Behind those to the actuators are the rates of the law's own states.
        """
        controller_memory = _broadcast_to_batch(self.initial_memory, 1)
        return jax.vmap(
            lambda state, time: self._control_law(controller_memory, state[:, None], time)[:, 0]
        )(states, times)

    def _control_law(self, controller_memory, state, time):
        """Commands (actuator, lane) of a law at every instant to a state; rates of own states."""
        case, outputs = self.plant.case, self.output_rows @ state
        pairs = zip(case.sensors, outputs[: len(case.sensors)], strict=True)
        readings = [filtered_reading(sensor, None, None, value)[0] for sensor, value in pairs]
        # What filters of the law's own give follows.
        readings = (
            jnp.stack([*readings, *outputs[len(case.sensors) :]]) if outputs.shape[0] else outputs
        )
        no_command = jnp.zeros((len(case.actuators), state.shape[-1]))
        controller_state = state[state.shape[0] - self.controller_states :]

        def law(own, moving, *seen):
            return jnp.concatenate(
                case.controller.flow(own, moving, Measurement(*seen), time, self._limit_commands)
            )

        plant_state = self.plant.from_modal(state[: self.plant.modal_model.state_count])
        batched_law = jax.vmap(law, in_axes=-1, out_axes=-1)
        return batched_law(controller_memory, controller_state, readings, plant_state, no_command)

    def _process_event(self, memory, state, step_info: StepInfo):
        """All that is due at an edge: readings, a new command, and commands that begin."""
        controller_memory, command, sensor_memory, reading_history, command_queue = memory
        case, schedule, event = self.plant.case, self.schedule, step_info.event
        signals = self._sensor_inputs(state, command, step_info.start)
        readings, states = [], []
        for i, sensor in enumerate(case.sensors):
            number = schedule.reading[event, i]
            noise = None if self.noise is None else self.noise[number, i]
            reading, after = filtered_reading(
                sensor, self.filter_sections[i], sensor_memory[i], signals[i], noise
            )
            due = number >= 0
            readings.append(jnp.where(due, reading, reading_history[0, i]))
            states.append(_tree_where(due, after, sensor_memory[i]))
            history = jnp.where(
                due, jnp.roll(reading_history[:, i], 1, axis=0), reading_history[:, i]
            )
            reading_history = reading_history.at[:, i].set(history.at[0].set(readings[-1]))

        def sampling_step(inputs):
            own, waiting = inputs
            arrived = self._available_readings(reading_history, event)
            wanted, own = self._controller_step(own, arrived, state, command, step_info.start)
            limited = self._limit_commands(wanted, waiting[0])
            return own, jnp.roll(waiting, 1, axis=0).at[0].set(limited)

        controller_memory, command_queue = jax.lax.cond(
            schedule.control_sample[event] >= 0,
            sampling_step,
            lambda inputs: inputs,
            (controller_memory, command_queue),
        )
        command_index = schedule.command_age[event]
        command = jnp.where(
            command_index >= 0, command_queue[jnp.maximum(command_index, 0)], command
        )
        return controller_memory, command, states, reading_history, command_queue

    def observe(self, memory, step_info: StepInfo):
        """Readings (sensor, lane) that have arrived, and failures (lane) of the controller."""
        controller = self.plant.case.controller
        if controller.period is None:
            return None
        return self._available_readings(memory[3], step_info.event), self.failures(memory)

    def failures(self, memory) -> Float[Array, " lane"]:
        """How many steps of the controller found no solution until now, in every lane."""
        controller_memory, commands = memory[:2]
        count = self.plant.case.controller.failures
        return jax.vmap(count, in_axes=-1, out_axes=-1, axis_size=commands.shape[-1])(
            controller_memory
        )

    def _available_readings(self, reading_history, event):
        """The newest readings (sensor, lane) that have arrived by an edge."""
        newest = [
            reading_history[self.schedule.reading_age[event, i], i]
            for i in range(reading_history.shape[1])
        ]
        return jnp.stack(newest) if newest else reading_history[0]

    def _sensor_inputs(self, state, command, time):
        """What the sensors see at an instant (sensor, lane)."""
        signals = self.output_rows @ state
        sensors = self.plant.case.sensors
        if not any(sensor.has_feedthrough for sensor in sensors):
            return signals
        _, accelerations = contact_at(self.model, self.loads, time, state, command)
        return sensor_rows(self.model, sensors).with_accelerations(signals, accelerations)

    def _controller_step(self, controller_memory, readings, state, command, time):
        """The controller's step in every lane."""

        def step(own, *seen):
            return self.plant.case.controller.step(own, Measurement(*seen), time)

        plant_state = self.plant.from_modal(state[: self.plant.modal_model.state_count])
        return jax.vmap(step, in_axes=-1, out_axes=-1)(
            controller_memory, readings, plant_state, command
        )

    def _limit_commands(self, commands, previous=None):
        """Commands as the actuators take them: rounded, within limits and rates of change."""
        controller, case = self.plant.case.controller, self.plant.case
        if controller.resolution is not None:
            rounded = controller.resolution * jnp.round(commands / controller.resolution)
            commands = commands + jax.lax.stop_gradient(rounded - commands)
        rows = []
        for i, actuator in enumerate(case.actuators):
            command, limits, rate = (
                commands[i],
                actuator.command_limits(),
                actuator.command_rate_limit(),
            )
            if limits is not None:
                command = jnp.clip(command, limits[0], limits[1])
            if rate is not None and previous is not None:
                change = rate * controller.period
                command = jnp.clip(command, previous[i] - change, previous[i] + change)
            rows.append(command)
        return jnp.stack(rows)


def newton_fixed_point(function, guess: Float[Array, "*shape lane"], iterations: int):
    """Find what a function gives back unchanged, in each lane by itself, by Newton's method."""
    batch_size = guess.shape[-1]
    size = guess.size // batch_size
    unit_vectors = jnp.broadcast_to(jnp.eye(size)[..., None], (size, size, batch_size))

    def iterate(value, _):
        value_of_function, derivative = jax.linearize(function, value)
        slopes = jax.vmap(derivative)(unit_vectors.reshape(size, *guess.shape)).reshape(
            unit_vectors.shape
        )
        residual = (value_of_function - value).reshape(size, batch_size)
        step = jnp.linalg.solve((unit_vectors - slopes).T, residual.T[..., None])
        return value + step[..., 0].T.reshape(guess.shape), None

    return jax.lax.scan(iterate, guess, length=iterations)[0]


def _broadcast_to_batch(memory, batch_size: int):
    """The same memory in all lanes, along a new last axis."""
    return jax.tree.map(
        lambda leaf: jnp.broadcast_to(jnp.asarray(leaf)[..., None], (*jnp.shape(leaf), batch_size)),
        memory,
    )


def _tree_where(condition, new, old):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def closed_loop(case: Case, layout: Layout, loads: LoadSet, schedule: EventSchedule) -> ClosedLoop:
    """The driver for a case that has a controller; its `rig` is the plant to integrate."""
    plant = state_space(case, layout=layout)
    augmented_model, output_rows = with_sensor_filters(plant)
    controller = case.controller
    if controller.period is None:
        filter_sections, noise = (None,) * len(case.sensors), None
    else:
        filter_sections = tuple(
            sensor_sections(sensor, controller.period) for sensor in case.sensors
        )
        noise = None
        if any(sensor.noise is not None for sensor in case.sensors):
            noise = noise_samples(case.run.seed, len(case.sensors), schedule.max_readings)
    implicit = controller.period is None and not controller.open_loop
    initial_memory = controller.init(plant)  # once: it may solve Riccati equations
    controller_states = controller.own_states(initial_memory) if implicit else 0
    augmented_model, output_rows = _with_controller_states(
        augmented_model, output_rows, controller_states
    )
    # A deflection about as large as the beam is long: modes are of the order sqrt(2 / mass).
    beam = case.beam
    max_deflection = beam.length * jnp.sqrt(beam.linear_density * beam.length / 2)
    state_bound = (
        jnp.full(augmented_model.state_count, jnp.inf)
        .at[0 : 2 * beam.modes : 2]
        .set(max_deflection)
    )
    return ClosedLoop(
        plant,
        initial_memory,
        augmented_model,
        output_rows,
        loads,
        schedule,
        filter_sections,
        noise,
        state_bound,
        implicit,
        controller_states,
    )


def _with_controller_states(
    model: ModalModel, output_rows: Float[Array, "sensor state"], count: int
) -> tuple[ModalModel, Float[Array, "sensor all"]]:
    """A rig with so many more states, whose rates are its last commands; no sensor sees them."""
    if count == 0:
        return model, output_rows
    state_matrix = jnp.pad(model.state_matrix, ((0, 0), (0, count), (0, count)))
    command_matrix = jax.scipy.linalg.block_diag(model.command_matrix, jnp.eye(count))
    parts = state_matrix, command_matrix
    augmented = eqx.tree_at(lambda r: (r.state_matrix, r.command_matrix), model, parts)
    return augmented, jnp.pad(output_rows, ((0, 0), (0, count)))
