"""Closed loop of a case: its schedule of events, and laws at samples and in continuous time.

A controller with a sampling period acts at multiples of it, on the readings available by then; its
command begins a delay later and is held, while the beam moves continuously in between. One without
a period acts in continuous time: its commands at the Gauss nodes of each step are found by Newton's
method together with the states there.
"""

import contextlib
import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractContinuousLaw, AbstractSampledLaw, Measurement
from jaxbeam.case.fields import concrete
from jaxbeam.model.contact import contact_at
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Layout
from jaxbeam.model.output_rows import OutputRows, sensor_rows
from jaxbeam.model.sensor_signals import (
    COMMANDS,
    NO_DERIVATIVE,
    filtered_reading,
    initial_filter_state,
    noise_samples,
    refuse_derivatives,
    sensor_sections,
    sent_readings,
    with_sensor_filters,
)
from jaxbeam.model.state_space import Plant, state_space
from jaxbeam.runtime.arrays import (
    Array,
    any_jax,
    block_diag,
    cond,
    is_jax,
    not_differentiated,
    scan,
    take,
    vmap,
    xp,
)
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.runtime.vectorised import NotVectorisedError, vectorised
from jaxbeam.simulation.commands import (
    CommandMemory,
    CommandPath,
    VoltageLimits,
    command_path,
    limit_commands,
    with_missing_voltages,
)
from jaxbeam.simulation.integrator.discrete_model import GAUSS_NODES, NODE_COUNT
from jaxbeam.simulation.integrator.inputs import AbstractInputPolicy, StepInfo, load_amplitude
from jaxbeam.simulation.integrator.time_grid import (
    EventSchedule,
    Transmission,
    controller_schedule,
    moving_with_end,
)

SHORTEST_STEP = 1e-12  # s, and of the time: far above the rounding of times
NEWTON_ITERATIONS = 4  # for the commands of a step; one suffices for a linear law


class ContinuousLoop(AbstractInputPolicy):
    """Input policy of a law in continuous time; its memory holds the commands at the last node.

    The model includes the analogue filters of sensors and law; its last states are the
    `controller_states` of the law, and their rates the last of its commands, before the voltages
    missing to those of inner loops if `voltages` have limits. `implicit` is False for open-loop
    commands, which do not depend on the state.
    """

    plant: Plant
    law: AbstractContinuousLaw
    model: ModalModel
    output_rows: Float[Array, "output state"]
    load_amplitude: Float[Array, " batch"]
    implicit: bool = eqx.field(static=True)
    controller_states: int = eqx.field(static=True)
    voltages: VoltageLimits | None = None

    def start(self, batch_size):
        return xp.zeros((self.model.command_matrix.shape[1], batch_size))

    def inputs(self, memory, state, info: StepInfo, states):
        if not self.implicit:
            commands = self.of_time(info)[..., None]
            commands = xp.broadcast_to(commands, (*commands.shape[:2], state.shape[-1]))
            return commands, commands[-1]
        times = _node_times(info)

        def commands_for(commands):
            of_batch = vmap(self._commands, in_axes=(-1, None), out_axes=-1)
            found = vmap(of_batch)(states(commands), times)
            if self.voltages is None:
                return found
            others = found.shape[1] - self.voltages.low.shape[0]
            missing = self.voltages.missing(found[:, others:])
            return xp.concatenate([found[:, :others], missing], axis=1)

        guess = xp.broadcast_to(memory, (NODE_COUNT, *memory.shape))
        commands = newton_fixed_point(commands_for, guess, NEWTON_ITERATIONS)
        return commands, commands[-1]

    def of_time(self, infos):
        if self.implicit:
            return None
        times = _node_times(infos)
        return self._open_loop_commands(times.ravel()).reshape(*times.shape, -1)

    def observe(self, memory, info):
        return None

    def failures(self, memory) -> Float[Array, " batch"]:
        """Number of samples without a solution: none, as there are no samples."""
        return xp.zeros(memory.shape[-1])

    def commands_at(
        self, states: Float[Array, "time state"], times: Float[Array, " time"]
    ) -> Float[Array, "time command"]:
        """Commands of a single run at some times (s): those to the actuators, then the others."""
        if not self.implicit:
            return self._open_loop_commands(times)
        if not any_jax(self, states, times):
            with contextlib.suppress(NotVectorisedError):
                return vectorised(self._commands)(states, times)
        return vmap(self._commands)(states, times)

    def _open_loop_commands(self, times):
        """Commands of a law of time alone, (time, command): limits are applied to all at once."""
        sensors, no_command = len(self.plant.case.sensors), xp.zeros(len(self.plant.case.actuators))
        states = self.plant.modal_model.state_count
        nothing = Measurement(xp.zeros(sensors), xp.zeros(states), no_command)
        law_state = xp.zeros(0)

        def of_time(time):
            return self.law.command(law_state, nothing, time)

        commands = None
        if not any_jax(self, times):
            with contextlib.suppress(NotVectorisedError):
                commands = vectorised(of_time)(times)
        commands = vmap(of_time)(times) if commands is None else commands
        return limit_commands(self.plant.case, commands.T).T

    def _commands(self, state, time):
        """Commands, rates of the law's states and voltages asked for, for the state of a run."""
        state = state[: self.model.state_count]  # without those of vehicles
        case, outputs = self.plant.case, self.output_rows @ state
        sensors = len(case.sensors)
        pairs = zip(case.sensors, outputs[:sensors], strict=True)
        readings = [filtered_reading(sensor, None, None, value)[0] for sensor, value in pairs]
        if outputs.shape[0]:
            outputs = xp.stack([*readings, *outputs[sensors:]])  # filters of the law follow
        law_state = state[state.shape[0] - self.controller_states :]
        plant_state = self.plant.from_modal(state[: self.plant.modal_model.state_count])
        measurement = Measurement(outputs, plant_state, xp.zeros(len(case.actuators)))
        command = limit_commands(case, self.law.command(law_state, measurement, time))
        rates = self.law.rates(law_state, measurement, command, time)
        if self.voltages is None:
            return xp.concatenate([command, rates])
        return xp.concatenate([command, rates, self.voltages.asked(state, command)])


def _node_times(infos: StepInfo) -> Float[Array, "*step node"]:
    """Times (s) of the Gauss nodes of a step, or of several.

    In a step of no length, commands that jump at its start have jumped.
    """
    length = xp.maximum(infos.length, SHORTEST_STEP * (1 + infos.start))
    return infos.start[..., None] + length[..., None] * GAUSS_NODES


def newton_fixed_point(
    function, guess: Float[Array, "*shape batch"], iterations: int
) -> Float[Array, "*shape batch"]:
    """Fixed point of a function by Newton's method, for each entry of a batch by itself."""
    batch_size = guess.shape[-1]
    size = guess.size // batch_size
    unit_vectors = xp.broadcast_to(xp.eye(size)[..., None], (size, size, batch_size))

    def iterate(value, _):
        function_value, derivative = jax.linearize(function, value)
        slopes = vmap(derivative)(unit_vectors.reshape(size, *guess.shape)).reshape(
            unit_vectors.shape
        )
        residual = (function_value - value).reshape(size, batch_size)
        step = xp.linalg.solve((unit_vectors - slopes).T, residual.T[..., None])
        return value + step[..., 0].T.reshape(guess.shape), None

    return scan(iterate, guess, length=iterations)[0]


class LoopMemory(NamedTuple):
    """Memory of a sampled loop, batch axis last.

    State of the law, commands on their way, states of the digital filters, latest readings and
    those not available yet (newest first), and the number of samples at which the law found no
    solution.
    """

    law_state: Any
    commands: CommandMemory
    filter_states: list
    readings: Float[Array, "age sensor batch"]
    failures: Float[Array, " batch"]


class SampledLoop(AbstractInputPolicy):
    """Input policy of a sampled law: one law for all runs of a batch, a memory for each.

    The model includes the analogue filters of the sensors; `filter_sections` are those of the
    digital ones. `measured_rows` are those of the quantities, of which accelerations follow from
    the forces too; None without accelerations. `path` is the way of the commands. With limits of
    `voltages` the last commands are the voltages missing at the Gauss nodes of each step.
    """

    plant: Plant
    law: AbstractSampledLaw
    model: ModalModel
    output_rows: Float[Array, "sensor state"]
    measured_rows: OutputRows | None
    load_amplitude: Float[Array, " batch"]
    loads: LoadSet
    schedule: EventSchedule
    filter_sections: tuple
    path: CommandPath
    noise: Float[Array, "sample sensor"] | None
    voltages: VoltageLimits | None = None
    implicit: bool = eqx.field(static=True, default=False)

    def acts_at(self, events):
        if self.voltages is not None:
            return super().acts_at(events)
        schedule, ages = self.schedule, self.schedule.reading_age
        due = np.any(schedule.reading >= 0, axis=1)
        due |= (schedule.control_sample >= 0) | (schedule.command_age >= 0)
        due[1:] |= np.any(ages[1:] != ages[:-1], axis=1)
        return (events >= 0) & due[events]

    def start(self, batch_size):
        sensors, zero = self.plant.case.sensors, xp.zeros(batch_size)
        pairs = list(zip(sensors, self.filter_sections, strict=True))
        filter_states = [initial_filter_state(sensor, part, zero) for sensor, part in pairs]
        readings = [
            filtered_reading(*pair, state, zero)[0]
            for pair, state in zip(pairs, filter_states, strict=True)
        ]
        readings = xp.stack(readings) if readings else xp.zeros((0, batch_size))
        return LoopMemory(
            _broadcast_to_batch(self.law.initial_state(), batch_size),
            self.path.start(batch_size, self.schedule.max_waiting),
            filter_states,
            xp.broadcast_to(readings, (self.schedule.max_age + 1, *readings.shape)),
            zero,
        )

    def inputs(self, memory: LoopMemory, state, info: StepInfo, states):
        memory = cond(
            info.event >= 0,
            lambda memory: self._process_event(memory, state, info),
            lambda memory: memory,
            memory,
        )
        acting = self.path.acting(memory.commands)
        commands = xp.broadcast_to(acting, (NODE_COUNT, *acting.shape))
        if self.voltages is None:
            return commands, memory
        limits = self.voltages

        def missing(voltages):
            at_nodes = states(xp.concatenate([commands, voltages], axis=1))
            return limits.missing(vmap(limits.asked)(at_nodes, commands))

        none = xp.zeros((NODE_COUNT, self.voltages.low.shape[0], acting.shape[-1]))
        found = newton_fixed_point(missing, none, NEWTON_ITERATIONS)
        return xp.concatenate([commands, found], axis=1), memory

    def observe(self, memory, info):
        """Available readings (sensor, batch), and number of failures of the law (batch).

        And the commands (actuator, batch) where they act through hysteresis or creep, else None.
        """
        through_operator = any(one is not None for one in self.path.operators)
        sent = memory.commands.command if through_operator else None
        return self._available_readings(memory.readings, info.event), memory.failures, sent

    def failures(self, memory) -> Float[Array, " batch"]:
        """Number of samples at which the law found no solution, up to the end of the run."""
        return memory.failures

    def _process_event(self, memory, state, info):
        """Memory after an event: samples of sensors, a step of the law, a command that begins."""
        schedule, event = self.schedule, info.event
        filter_states, readings = self._sample_sensors(memory, state, info)

        def step(inputs):
            law_state, commands, failures = inputs
            available = self._available_readings(readings, event)
            acting = self.path.assumed_commands(commands, schedule.assumed_age)
            command, law_state, solved = self._step_law(law_state, available, state, acting, info)
            return law_state, self.path.send(commands, command), failures + ~solved

        law_state, commands, failures = cond(
            take(schedule.control_sample, event) >= 0,
            step,
            lambda inputs: inputs,
            (memory.law_state, memory.commands, memory.failures),
        )
        commands = self.path.begin(commands, take(schedule.command_age, event))
        return LoopMemory(law_state, commands, filter_states, readings, failures)

    def _sample_sensors(self, memory, state, info):
        """Filter states and readings after the samples that are due at an event."""
        readings, filter_states, histories = memory.readings, [], []
        numbers = take(self.schedule.reading, info.event)
        signals = cond(
            xp.any(numbers >= 0),
            lambda state: self._sensor_inputs(state, self.path.acting(memory.commands), info.start),
            lambda state: xp.zeros((self.output_rows.shape[0], state.shape[1])),
            state,
        )
        for i, (sensor, number) in enumerate(zip(self.plant.case.sensors, numbers, strict=False)):
            if not is_jax(number) and number < 0:
                filter_states.append(memory.filter_states[i])
                histories.append(readings[:, i])
                continue
            noise = None if self.noise is None else take(self.noise, (number, i))
            reading, filter_state = filtered_reading(
                sensor, self.filter_sections[i], memory.filter_states[i], signals[i], noise
            )
            due = number >= 0
            filter_states.append(_tree_where(due, filter_state, memory.filter_states[i]))
            shifted = xp.concatenate([reading[None], readings[:-1, i]])
            histories.append(_tree_where(due, shifted, readings[:, i]))
        return filter_states, xp.stack(histories, axis=1) if histories else readings

    def _available_readings(self, readings, event):
        """Latest readings (sensor, batch) that are available at an event."""
        ages = take(self.schedule.reading_age, event)[: readings.shape[1]]
        return take(readings, (ages, np.arange(readings.shape[1])))

    def _sensor_inputs(self, state, command, time):
        """Inputs of the sensors (sensor, batch) at a time (s)."""
        signals = self.output_rows @ state[: self.model.state_count]
        if self.measured_rows is None:
            return signals
        missing = self.model.command_matrix.shape[1] - command.shape[0]  # drive no mode at once
        command = xp.concatenate([command, xp.zeros((missing, command.shape[1]))])
        contact = contact_at(self.model, self.loads, time, state, command)
        return self.measured_rows.with_accelerations(signals, contact.modal_acceleration)

    def _step_law(self, law_state, readings, state, command, info):
        """Step of the law for each run of the batch."""
        missing = self.schedule.missing
        present = None if missing is None else ~take(missing, info.event)

        def step(law_state, *measured):
            measurement = Measurement(*measured)._replace(present=present)
            return self.law.step(law_state, measurement, info.start)

        plant_state = self.plant.from_modal(state[: self.plant.modal_model.state_count])
        return vmap(step, in_axes=-1, out_axes=-1)(law_state, readings, plant_state, command)


def _broadcast_to_batch(state, batch_size: int):
    """The same state for each run, along a new last axis."""
    return jax.tree.map(
        lambda leaf: xp.broadcast_to(xp.asarray(leaf)[..., None], (*xp.shape(leaf), batch_size)),
        state,
    )


def _tree_where(condition, new, old):
    """Numbers of one tree or of another with the same structure."""
    if not is_jax(condition):
        return new if condition else old
    return jax.tree.map(lambda a, b: xp.where(condition, a, b), new, old)


SAME_TIME_FRACTION = 1e-9  # of a period
MOVING = "period", "delay", "sampling_period", "jitter", "times"  # numbers that move events
FIXED = (
    "periods, delays and times of samples are fixed by a plan made without tracing them:"
    " differentiate without a plan, or make it with moving=True"
)
LOST = NO_DERIVATIVE.format("dropout", "is lost")


def loop_schedule(
    case: Case,
    samples: Float[np.ndarray, " time"],
    end: float | None = None,
    moving: bool = False,
) -> EventSchedule:
    """Events of control, sensors and commands of a case up to the `end` (s) of the run.

    By default it ends with the last of the saved samples (s). A `moving` schedule is for
    derivatives by its times (`moved_schedule`).
    """
    controller, end = case.controller, float(samples[-1] if end is None else max(end, samples[-1]))
    breakpoints = controller.breakpoints(case)
    breakpoints = np.zeros(0) if breakpoints is None else concrete(breakpoints)
    if controller.period is None:
        none = Transmission(np.zeros(0), np.zeros(0))
        return controller_schedule(samples, none, [], breakpoints, end, moving=moving)

    def sampling_times(period):
        return np.arange(int(np.floor(end / period * (1 + 1e-12))) + 1) * period

    def delays_and_losses(number, part, times):
        losses, late = sent_readings(case.run.seed, number, part, times.size)
        delay = 0.0 if part.delay is None else float(concrete(part.delay))
        delay = delay if late is None else delay + concrete(late)
        return delay, None if losses is None else concrete(losses).astype(bool)

    readings = []
    for i, sensor in enumerate(case.sensors):
        own = controller.period if sensor.sampling_period is None else sensor.sampling_period
        arrivals = sampling_times(float(concrete(own)))
        delays, losses = delays_and_losses(i, sensor, arrivals)
        readings.append(Transmission(arrivals - delays, arrivals, losses))
    sent = sampling_times(float(concrete(controller.period)))
    delays, losses = delays_and_losses(COMMANDS, controller, sent)
    commands, assumed_age = Transmission(sent, sent + delays, losses), None
    if controller.dropout is not None or controller.jitter is not None:
        assumed_age = command_lag(case) - 1
    parts = samples, commands, readings, breakpoints, end, assumed_age
    return controller_schedule(*parts, moving)


def moved_schedule(
    case: Case, schedule: EventSchedule, samples: Float[Array, " time"], to_duration: bool
) -> EventSchedule:
    """A moving schedule at the times (s) that the case has, as long as their order stays.

    The run ends with the last of the `samples` (s) or `to_duration`.
    """
    controller, (of_table, *counts, _, _) = case.controller, schedule.source_counts
    breakpoints = xp.zeros(of_table)
    if controller.open_loop and of_table:
        breakpoints = xp.asarray(controller.breakpoints(case))
    elif of_table:  # those of a filter, whose gain has kinks there but no jumps
        kept = xp.where(schedule.source < of_table, -1, schedule.source)
        schedule = dataclasses.replace(schedule, source=kept)

    def delays(number, part, count):
        late = sent_readings(case.run.seed, number, part, count)[1]
        delay = 0.0 if part.delay is None else part.delay
        return delay if late is None else delay + late

    times = [breakpoints]
    if controller.period is not None:
        for i, (sensor, count) in enumerate(zip(case.sensors, counts, strict=False)):
            own = controller.period if sensor.sampling_period is None else sensor.sampling_period
            times.append(xp.arange(count) * own - delays(i, sensor, count))
        sent = xp.arange(counts[-1]) * controller.period
        times += [sent, sent + delays(COMMANDS, controller, counts[-1])]
    end = samples[-1]
    if to_duration:
        end = case.run.duration
        samples = moving_with_end(samples, end)
    actions = moving_with_end(xp.concatenate(times), end)
    return schedule.moved(xp.concatenate([actions, samples, end[None]]))


def moves_events(case: Case, times=None) -> bool:
    """Whether times of events of a controlled run are traced, so that they have derivatives."""
    controller = case.controller
    numbers = [case.run.duration, case.run.sample_rate, times]
    if controller.open_loop and controller.period is None:
        numbers.append(controller.breakpoints(case))
    for part in (controller, *_sampled_sensors(case)):
        numbers += [getattr(part, name, None) for name in MOVING]
    return any(isinstance(number, jax.core.Tracer) for number in numbers)


def _sampled_sensors(case: Case) -> tuple:
    """Sensors whose delays move events: a law without a period takes no samples of them."""
    return () if case.controller.period is None else case.sensors


def with_fixed_losses(case: Case) -> Case:
    """The case; derivatives of its results by a `dropout` raise ValueError."""
    return _fixed(case, LOST, "dropout")


def with_fixed_events(case: Case, times) -> tuple[Case, Any]:
    """The case and the times of its samples, whose events have no derivatives.

    Differentiating by numbers that move events, such as periods and delays, raises ValueError.
    """
    if not moves_events(case, times):
        return case, times
    fixed = _fixed(dataclasses.replace(case, sensors=_sampled_sensors(case)), FIXED, *MOVING)
    case = dataclasses.replace(fixed, sensors=fixed.sensors or case.sensors)
    values = {name: getattr(case.run, name) for name in ("duration", "sample_rate")}
    values = {name: not_differentiated(value, FIXED) for name, value in values.items()}
    changed = dataclasses.replace(case, run=dataclasses.replace(case.run, **values))
    return changed, not_differentiated(times, FIXED)


def _fixed(case: Case, reason: str, *names: str) -> Case:
    """The case; derivatives by these fields of controller and sensors raise ValueError."""

    def fixed(part):
        values = {name: getattr(part, name, None) for name in names}
        traced = {n: v for n, v in values.items() if isinstance(v, jax.core.Tracer)}
        changes = {name: not_differentiated(value, reason) for name, value in traced.items()}
        return dataclasses.replace(part, **changes) if changes else part

    parts = fixed(case.controller), tuple(map(fixed, case.sensors))
    return dataclasses.replace(case, controller=parts[0], sensors=parts[1])


def command_lag(case: Case) -> int:
    """Number of sampling periods from the sample of a command to the first at which it acts."""
    delay = 0.0 if case.controller.delay is None else float(concrete(case.controller.delay))
    return math.floor(delay / float(concrete(case.controller.period)) + SAME_TIME_FRACTION) + 1


def closed_loop(
    case: Case,
    layout: Layout,
    loads: LoadSet,
    schedule: EventSchedule,
    noisy: bool = True,
    known: tuple[Plant, tuple[ModalModel, Array]] | None = None,
) -> SampledLoop | ContinuousLoop:
    """Input policy for a case that has a controller; its `model` is the one to be integrated.

    Without `noisy` the sensors have no noise. Of a loop with samples its plant, and the model and
    rows with the filters of the sensors may be `known`. Raises TypeError if the law of the
    controller has not the interface for samples, or for continuous time if it has no period.
    """
    plant = state_space(case, layout=layout) if known is None else known[0]
    controller = case.controller
    for part in (controller, *case.sensors):  # the schedule has them as they are
        refuse_derivatives(part)
    law = controller.law(plant)  # once: the design may solve Riccati equations
    interface = AbstractContinuousLaw if controller.period is None else AbstractSampledLaw
    if not isinstance(law, interface):
        raise TypeError(
            f"the law of a {type(controller).__name__} is a {type(law).__name__}, no"
            f" {interface.__name__}: "
            + ("give a period" if controller.period is None else "leave the period out")
        )
    least = load_amplitude(case, plant.modal_model, loads)
    if controller.open_loop:
        least = xp.full(least.shape, xp.inf)
    if controller.period is None:
        model, output_rows = with_sensor_filters(plant, law.filters)
        states = 0 if controller.open_loop else law.state_count
        model, output_rows = _with_controller_states(model, output_rows, states)
        model, voltages = with_missing_voltages(case, plant.modal_model, model)
        implicit = not controller.open_loop or voltages is not None
        return ContinuousLoop(plant, law, model, output_rows, least, implicit, states, voltages)
    if not any_jax(plant, law, schedule):
        law = law.tabulated(schedule.times[schedule.control_sample >= 0])
    model, output_rows = with_sensor_filters(plant) if known is None else known[1]
    model, voltages = with_missing_voltages(case, plant.modal_model, model)
    sections = tuple(sensor_sections(sensor, controller.period) for sensor in case.sensors)
    noise = None
    if noisy and any(sensor.noise is not None for sensor in case.sensors):
        noise = noise_samples(case.run.seed, len(case.sensors), schedule.max_readings)
    measured_rows = None
    if any(sensor.has_feedthrough for sensor in case.sensors):
        measured_rows = sensor_rows(model, case, case.sensors)
    return SampledLoop(
        plant=plant,
        law=law,
        model=model,
        output_rows=output_rows,
        measured_rows=measured_rows,
        load_amplitude=least,
        loads=loads,
        schedule=schedule,
        filter_sections=sections,
        path=command_path(case),
        noise=noise,
        voltages=voltages,
        implicit=voltages is not None,
    )


@compiled_if_traced
def loop_of_case(
    case: Case, layout: Layout, schedule: EventSchedule
) -> SampledLoop | ContinuousLoop:
    """`closed_loop` with the loads of the case, computed in NumPy if its numbers are concrete."""
    return closed_loop(case, layout, load_set(case, layout), schedule)


def _with_controller_states(
    model: ModalModel, output_rows: Float[Array, "sensor state"], count: int
) -> tuple[ModalModel, Float[Array, "sensor all"]]:
    """Model with `count` states added for a controller, whose rates are its last commands.

    Also `output_rows` on the larger state; no output contains the states added.
    """
    if count == 0:
        return model, output_rows
    state_matrix = xp.pad(model.state_matrix, ((0, 0), (0, count), (0, count)))
    command_matrix = block_diag(model.command_matrix, xp.eye(count))
    parts = state_matrix, command_matrix
    augmented = eqx.tree_at(lambda r: (r.state_matrix, r.command_matrix), model, parts)
    return augmented, xp.pad(output_rows, ((0, 0), (0, count)))
