"""Closed loop of a case: its schedule of events, and the input policy of the integrator.

A controller with a sampling period acts at samples (`sampled_loop`), one without a period in
continuous time (`continuous_loop`).
"""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractContinuousLaw, AbstractSampledLaw
from jaxbeam.case.fields import concrete
from jaxbeam.integrator.growth import load_amplitude
from jaxbeam.integrator.time_grid import (
    EventSchedule,
    Transmission,
    controller_schedule,
    moving_with_end,
)
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Layout
from jaxbeam.model.sensing.output_rows import sensor_rows
from jaxbeam.model.sensing.sensor_signals import (
    COMMANDS,
    NO_DERIVATIVE,
    noise_samples,
    refuse_derivatives,
    sensor_sections,
    sent_readings,
    with_sensor_filters,
)
from jaxbeam.model.state_space import Plant, state_space
from jaxbeam.runtime.arrays import Array, any_jax, block_diag, not_differentiated, xp
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.simulation.commands import command_path
from jaxbeam.simulation.continuous_loop import ContinuousLoop
from jaxbeam.simulation.sampled_loop import SampledLoop

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
        return ContinuousLoop(
            plant, law, model, output_rows, least, not controller.open_loop, states
        )
    if not any_jax(plant, law, schedule):
        law = law.tabulated(schedule.times[schedule.control_sample >= 0])
    model, output_rows = with_sensor_filters(plant) if known is None else known[1]
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
