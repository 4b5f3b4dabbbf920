"""Step of a program in C as a function in Python, and the recorded closed loop that checks it.

From measurements to limited commands it is traced and translated to C; NumPy runs it as well.
Recorded are the inputs of the program and the commands expected of it.
"""

import dataclasses
import math
from dataclasses import fields
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractController, AbstractSampledLaw, ControlStep, Measurement
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import Sensor, filter_step
from jaxbeam.control.crossing_gains import GainSchedule
from jaxbeam.control.feedforward import ConfirmedFeedforwardLaw, FeedforwardLaw
from jaxbeam.control.load_identification import GateIdentifier, GivenLoad
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import Layout
from jaxbeam.model.sensor_signals import (
    Sections,
    initial_filter_state,
    possible_readings,
    sensor_sections,
    to_reading,
)
from jaxbeam.runtime.arrays import Array, Module, any_jax, is_jax, take, to_numpy, vmap, xp
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.simulation.closed_loop import SampledLoop, command_lag, loop_schedule
from jaxbeam.simulation.commands import CommandMemory, CommandPath, command_path
from jaxbeam.simulation.integration_plan import (
    IntegrationPlan,
    static_shapes,
    steps_per_interval,
)
from jaxbeam.simulation.integrator.integrate import (
    integrate_history,
    longest_force_step,
    max_stable_step,
)
from jaxbeam.simulation.simulate import integration_setup


class RecordedLoop(NamedTuple):
    """Samples of a loop: times (s), readings before their digital filters, states of the plant.

    Missing readings are NaN. `commands` are those that the law gives at each sample, after limits
    and resolution.
    """

    times: Float[np.ndarray, " sample"]
    readings: Float[np.ndarray, "sample sensor"]
    states: Float[np.ndarray, "sample state"]
    commands: Float[np.ndarray, "sample actuator"]


class FilteredState(NamedTuple):
    """States of a law and of the digital filters before it, and its last readings."""

    law: Any
    filters: list
    readings: Float[Array, " sensor"]


class FilteredLaw(AbstractSampledLaw):
    """Law whose readings pass the digital filters of its sensors, which start from rest.

    At a missing sample a filter keeps its state and its last output.
    """

    law: AbstractSampledLaw
    sections: tuple[Sections, ...]
    sensors: tuple[Sensor, ...]

    def initial_state(self):
        pairs = zip(self.sensors, self.sections, strict=True)
        filter_states = [initial_filter_state(*pair, 0.0) for pair in pairs]
        at_rest = [to_reading(sensor, 0.0) for sensor in self.sensors]
        return FilteredState(self.law.initial_state(), filter_states, xp.array(at_rest))

    def tabulated(self, times):
        return dataclasses.replace(self, law=self.law.tabulated(times))

    def step(self, state, measurement, t):
        law_state, filter_states, last = state
        readings, after = [], []
        for i, sections in enumerate(self.sections):
            reading, filter_state = measurement.readings[i], filter_states[i]
            if sections is not None:
                found = filter_step(sections, filter_state, reading)
                if measurement.present is not None:
                    is_new, before = measurement.present[i], (last[i], filter_state)
                    found = (xp.where(is_new, *pair) for pair in zip(found, before, strict=True))
                reading, filter_state = found
            readings.append(reading)
            after.append(filter_state)
        if readings:
            measurement = measurement._replace(readings=xp.stack(readings))
        step = self.law.step(law_state, measurement, t)
        if not any_jax(measurement):  # also of laws that use JAX for concrete numbers
            step = to_numpy(step)
        state = FilteredState(step.state, after, measurement.readings)
        return ControlStep(step.command, state, step.solved)


class _Recorder(SampledLoop):
    """Sampled loop whose observations are readings, NaN if missing, and the last commands sent."""

    def observe(self, memory, info):
        readings = self._available_readings(memory.readings, info.event)
        if self.schedule.missing is not None:
            missing = take(self.schedule.missing, info.event)[:, None]
            readings = xp.where(missing, xp.nan, readings)
        return readings, memory.commands.queue[0]


class _DesignedController(AbstractController):
    """Controller with a law that is designed already."""

    law_to_run: Any = None

    def law(self, plant):
        return self.law_to_run

    def design_law(self, plant):
        return self.law_to_run


def filters_in_program(case: Case) -> tuple[Sections, ...]:
    """Sections of the digital filters that act on samples at the period of the controller.

    None for a sensor without one, or with a sampling period of its own: its readings come filtered.
    """
    period = case.controller.period
    return tuple(
        None if sensor.sampling_period is not None else sensor_sections(sensor, period)
        for sensor in case.sensors
    )


def recorded_loop(case: Case, law: AbstractSampledLaw, max_samples: int) -> RecordedLoop:
    """Loop of a case with a designed law, over the run or its first samples.

    Raises ValueError if the loop diverges.
    """
    controller, sections = case.controller, filters_in_program(case)
    sensors = tuple(
        sensor if part is None else eqx.tree_at(lambda s: s.filter, sensor, None)
        for sensor, part in zip(case.sensors, sections, strict=True)
    )
    period, duration = (float(concrete(x)) for x in (controller.period, case.run.duration))
    count = min(math.floor(duration / period * (1 + 1e-12)) + 1, max_samples)
    times = np.arange(count + 1) * period
    settings = "period", "delay", "resolution", "dropout", "jitter"
    recorded = _DesignedController(
        **{name: getattr(controller, name) for name in settings},
        law_to_run=FilteredLaw(law, sections, case.sensors),
    )
    case = eqx.tree_at(
        lambda c: (c.sensors, c.controller), case, (sensors, recorded), is_leaf=lambda x: x is None
    )
    plan = _plan(case, times)
    readings, states, commands = (np.asarray(part) for part in _run(case, plan, times))
    if not all(np.isfinite(part).all() for part in (states, commands)):
        raise ValueError("the closed loop diverges, so that there are no commands to check it by")
    return RecordedLoop(times[:-1], readings[:-1], states[:-1], commands[:-1])


def _plan(case: Case, times: Float[np.ndarray, " sample"]) -> IntegrationPlan:
    """Plan with the longest stable steps, without a trial run: accuracy does not matter here."""
    shapes, schedule = static_shapes(case), loop_schedule(case, times)
    longest = _longest_step(case, shapes.layout)
    substeps = steps_per_interval(float(schedule.lengths.max()), float(longest))
    return IntegrationPlan(shapes, substeps, 0, False, 0.0, schedule)


@compiled_if_traced
def _longest_step(case: Case, layout: Layout) -> Array:
    """Longest stable time step (s) of the beam under its loads."""
    loads = load_set(case, layout)
    stable = max_stable_step(modal_model(case, layout), loads)
    return xp.minimum(stable, longest_force_step(case, loads))


@compiled_if_traced
def _run(case: Case, plan: IntegrationPlan, times) -> tuple[Array, Array, Array]:
    """Readings, states of the plant and commands sent to the actuators at the samples."""
    discrete, loads, policy, sample_steps, steps, _ = integration_setup(case, plan, times, None)
    policy = _Recorder(**{field.name: getattr(policy, field.name) for field in fields(policy)})
    _, states, _, (readings, commands), _ = integrate_history(
        discrete, loads, max_loads=plan.shapes.max_loads, steps=steps, policy=policy
    )
    plant = policy.plant
    states = states[sample_steps, : plant.modal_model.state_count, 0]
    sample_steps = xp.minimum(sample_steps, len(readings) - 1)  # no step starts at the end
    sampled = readings[sample_steps, :, 0], commands[sample_steps, :, 0]
    return sampled[0], vmap(plant.from_modal)(states), sampled[1]


GATE_TIMES = "gate_times"
SETTINGS = {  # numbers of a law that may be changed while a program runs
    GivenLoad: ("mass", "speed", "entry_time"),
    GainSchedule: ("start", "end"),
    **dict.fromkeys((GateIdentifier, FeedforwardLaw, ConfirmedFeedforwardLaw), (GATE_TIMES,)),
}
NEVER = 1e30  # s, of a gate that has not been passed


class ProgramState(NamedTuple):
    """State of a program from sample to sample.

    It has the state of the law with its filters and last readings; the last command of the law
    before limits; delayed commands, of one run; and numbers that may be set, by their names.
    """

    law: Any
    wanted: Float[Array, " actuator"]
    commands: CommandMemory
    settings: dict[str, Array]


class SampledProgram(Module):
    """Law of a case with the filters of its sensors, and limits and delay of its commands.

    `ranges` (sensor, 2) are those of the readings; `begun` is the age at which commands act.
    """

    law: FilteredLaw
    path: CommandPath
    ranges: Float[np.ndarray, "sensor 2"]
    begun: int
    settings: dict[str, Array]

    def start(self) -> ProgramState:
        """Initial state of a run, at rest."""
        return ProgramState(
            self.law.initial_state(),
            np.zeros(len(self.path.case.actuators)),
            self.path.start(1, self.begun),
            self.settings,
        )

    def step(
        self,
        state: ProgramState,
        measurements: Float[Array, " sensor"],
        plant_state: Float[Array, " state"],
        t: Float[Array, ""],
    ) -> tuple[Float[Array, " actuator"], ProgramState]:
        """Commands to be sent at a time (s), and the next state.

        A measurement that is no number, or outside of its range, is missing. A law with a number
        that is not finite starts again, and its last command stays.
        """
        low, high = self.ranges.T
        present = (measurements >= low) & (measurements <= high)
        last = state.law.readings
        readings = xp.where(present, measurements, last) if low.size else last
        known_command = self.path.assumed_commands(state.commands)[:, 0]
        measurement = Measurement(readings, plant_state, known_command, present)
        law = with_settings(self.law, state.settings)
        found = law.step(state.law, measurement, t)
        leaves = jax.tree.leaves((found.state, found.command))
        numbers = xp.concatenate([xp.ravel(leaf) for leaf in leaves if _is_real(leaf)])
        finite = xp.all(xp.isfinite(numbers))
        wanted = xp.where(finite, found.command, state.wanted)
        start = self.law.initial_state()
        after = jax.tree.map(lambda new, old: xp.where(finite, new, old), found.state, start)
        commands = self.path.send(state.commands, wanted[:, None])
        sent = commands.queue[0][:, 0]
        commands = self.path.begin(commands, np.array(self.begun))
        return sent, ProgramState(after, wanted, commands, state.settings)


def sampled_program(case: Case, law: AbstractSampledLaw, samples: int) -> SampledProgram:
    """Program of a case and its designed law, with tables over so many samples."""
    sections = filters_in_program(case)
    filtered = FilteredLaw(law, sections, case.sensors)
    times = np.arange(samples) * float(concrete(case.controller.period))
    # A reading that comes filtered may be beyond the range of its samples.
    ranges = [
        possible_readings(
            dataclasses.replace(sensor, range=None)
            if sensor.has_digital_filter and part is None
            else sensor
        )
        for sensor, part in zip(case.sensors, sections, strict=True)
    ]
    path = command_path(case)
    without = dataclasses.replace(path, operators=(None,) * len(case.actuators))
    return SampledProgram(
        filtered.tabulated(times),
        without,
        np.reshape(ranges, (-1, 2)).astype(float),
        command_lag(case) - 1,
        settings_of(law),
    )


def settings_of(law: AbstractSampledLaw) -> dict[str, np.ndarray]:
    """Initial values of the numbers of a law that may be set, by their names.

    Gates have not been passed then.
    """
    found: dict[str, np.ndarray] = {}
    for part in jax.tree.leaves(law, is_leaf=_has_settings):
        for name in _names(part):
            values = np.asarray(getattr(part, name), float)
            values = np.where(np.isnan(values), 0.0, values)  # not used
            found[name] = np.full(values.shape, NEVER) if name == GATE_TIMES else values
    return found


def with_settings(law, settings: dict[str, Array]):
    """Law with other values of numbers that may be set."""

    def changed(part):
        names = _names(part)
        return (
            dataclasses.replace(part, **{name: settings[name] for name in names}) if names else part
        )

    return jax.tree.map(changed, law, is_leaf=_has_settings)


def gate_times_of(law: AbstractSampledLaw) -> Float[np.ndarray, "load 2"]:
    """Times (s) at which the loads of a case pass the gates of its law; none without gates."""
    for part in jax.tree.leaves(law, is_leaf=_has_settings):
        if GATE_TIMES in _names(part):
            return np.reshape(np.asarray(getattr(part, GATE_TIMES), float), (-1, 2))
    return np.zeros((0, 2))


def _has_settings(part: Any) -> bool:
    return bool(_names(part))


def _names(part: Any) -> tuple[str, ...]:
    """Names of the numbers of a part that may be set; of tables of schedules there are none."""
    names = SETTINGS.get(type(part), ())
    return (
        names if GATE_TIMES in names or all(np.ndim(getattr(part, n)) == 0 for n in names) else ()
    )


def _is_real(leaf: Any) -> bool:
    dtype = leaf.dtype if is_jax(leaf) else np.asarray(leaf).dtype
    return np.issubdtype(dtype, np.floating)
