"""Closed loop of a case: its schedule of events, and the input policy of the integrator.

A controller with a sampling period acts at samples (`sampled_loop`), one without a period in
continuous time (`continuous_loop`).
"""

import math

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractContinuousLaw, AbstractSampledLaw
from jaxbeam.case.fields import concrete
from jaxbeam.integrator.events import EventSchedule, Transmission, controller_schedule
from jaxbeam.integrator.growth import load_amplitude
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Layout
from jaxbeam.model.sensing.output_rows import sensor_rows
from jaxbeam.model.sensing.sensor_filters import with_sensor_filters
from jaxbeam.model.sensing.sensor_signals import noise_samples, sensor_sections
from jaxbeam.model.sensing.transmission import COMMANDS, sent_readings
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.arrays import Array, any_jax, block_diag, xp
from jaxbeam.simulation.commands.path import command_path
from jaxbeam.simulation.continuous_loop import ContinuousLoop
from jaxbeam.simulation.sampled_loop import SampledLoop

SAME_TIME_SHARE = 1e-9  # of a period


def loop_schedule(
    case: Case, samples: Float[np.ndarray, " time"], end: float | None = None
) -> EventSchedule:
    """Events of control, sensors and commands of a case up to the `end` (s) of the run.

    By default it ends with the last of the saved samples (s).
    """
    controller, end = case.controller, float(samples[-1] if end is None else max(end, samples[-1]))
    breakpoints = controller.breakpoints(case)
    breakpoints = np.zeros(0) if breakpoints is None else concrete(breakpoints)
    if controller.period is None:
        none = Transmission(np.zeros(0), np.zeros(0))
        return controller_schedule(samples, none, [], breakpoints, end)

    def sampling_times(period):
        return np.arange(int(np.floor(end / period * (1 + 1e-12))) + 1) * period

    def delays_and_losses(number, part, times):
        losses, late = sent_readings(case.run.seed, number, part, times.size)
        delay = 0.0 if part.delay is None else float(concrete(part.delay))
        delays = delay if late is None else delay + concrete(late)
        return delays, None if losses is None else concrete(losses).astype(bool)

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
    return controller_schedule(samples, commands, readings, breakpoints, end, assumed_age)


def command_lag(case: Case) -> int:
    """Samples from the one of a command to the first at which it acts already."""
    delay = 0.0 if case.controller.delay is None else float(concrete(case.controller.delay))
    return math.floor(delay / float(concrete(case.controller.period)) + SAME_TIME_SHARE) + 1


def closed_loop(
    case: Case, layout: Layout, loads: LoadSet, schedule: EventSchedule, noisy: bool = True
) -> SampledLoop | ContinuousLoop:
    """Input policy for a case that has a controller; its `model` is the one to be integrated.

    Without `noisy` the sensors have no noise. Raises TypeError if the law of the controller has not
    the interface for samples, or for continuous time if it has no period.
    """
    plant, controller = state_space(case, layout=layout), case.controller
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
    model, output_rows = with_sensor_filters(plant)
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


def _with_controller_states(
    model: ModalModel, output_rows: Float[Array, "sensor state"], count: int
) -> tuple[ModalModel, Float[Array, "sensor all"]]:
    """Model with more states, whose rates are its last commands and which no output contains."""
    if count == 0:
        return model, output_rows
    state_matrix = xp.pad(model.state_matrix, ((0, 0), (0, count), (0, count)))
    command_matrix = block_diag(model.command_matrix, xp.eye(count))
    parts = state_matrix, command_matrix
    augmented = eqx.tree_at(lambda r: (r.state_matrix, r.command_matrix), model, parts)
    return augmented, xp.pad(output_rows, ((0, 0), (0, count)))
