"""Signals of sensors of beam and vehicles: noise, filters, sampling, delays and lost readings.

In this order: analogue filter; sampling of the signal `delay` and a random delay before; offset and
noise; range and resolution; loss; digital filter of the samples that are not lost.
`filtered_reading` makes a single reading from a sampled value; `sampled_readings` makes all
readings of a history, with analogue filter, delay, clock and losses.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import ControllerFilter
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.loads.vehicle_parts import VehicleSensor
from jaxbeam.case.sensors import (
    Filter,
    Sensor,
    analogue_state_space,
    analogue_steady_state,
    filter_history,
    filter_step,
    second_order_sections,
    steady_filter_state,
)
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Modes
from jaxbeam.model.output_rows import sensor_history, sensor_rows
from jaxbeam.model.state_space import Plant
from jaxbeam.model.static_correction import Motion
from jaxbeam.numerics.normal_samples import normal_samples, uniform_samples
from jaxbeam.numerics.stages import c2d, evaluate_cubics, hermite_cubics
from jaxbeam.runtime.arrays import (
    Array,
    add_at,
    block_diag,
    not_differentiated,
    scan,
    set_at,
    stop_gradient,
    take,
    xp,
)

COMMANDS = -1  # the number that stands for the commands, among those of the sensors
LOSSES, DELAYS = 1, 2  # streams of random numbers within that of a sensor or of the commands

NO_DERIVATIVE = (
    "what {1} is drawn by a seed and jumps with the {0}, so that there is no derivative by it:"
    " compare several of its values"
)


def refuse_derivatives(part: Any) -> None:
    """Raise ValueError if there are derivatives by dropout or jitter of a part of a loop."""
    for name, what in (("dropout", "is lost"), ("jitter", "is late in a loop")):
        not_differentiated(getattr(part, name), NO_DERIVATIVE.format(name, what))


def sent_readings(
    seed: int, number: int, part: Any, count: int
) -> tuple[Bool[Array, " sample"] | None, Float[Array, " sample"] | None]:
    """Losses and random delays (s) of the first `count` readings of a sensor; None for none.

    `part` has `dropout` and `jitter`: a sensor of this number, or a controller for its COMMANDS.
    Derivatives by the dropout raise ValueError.
    """
    losses = late = None
    if part.dropout is not None:
        dropout = not_differentiated(part.dropout, NO_DERIVATIVE.format("dropout", "is lost"))
        losses = xp.asarray(uniform_samples(seed, (number + 1, LOSSES), count)) < dropout
    if part.jitter is not None:
        late = part.jitter * uniform_samples(seed, (number + 1, DELAYS), count)
    return losses, late


def with_sensor_filters(
    plant: Plant, controller_filters: Sequence[ControllerFilter] = ()
) -> tuple[ModalModel, Float[Array, "sensor state"]]:
    """Modal model with states of the analogue filters, and rows from its states to their outputs.

    Rows are those of the sensors, then those of the filters of a control law. Rows of acceleration
    sensors are zero: accelerations depend on contact forces and commands too.
    """
    case, model = plant.case, plant.modal_model
    state_matrices, filter_inputs, rows = [model.A], [], []
    on_states, _ = sensor_rows(model, case, case.sensors).on_states(model)
    for sensor, row in zip(case.sensors, on_states, strict=True):
        if sensor.filter is None or sensor.filter.realisation != "analogue":
            rows.append({0: row})
            continue
        matrix, column, output, _ = analogue_state_space(sensor.filter)
        filter_inputs.append((len(state_matrices), column, {0: row}))
        rows.append({len(state_matrices): output})
        state_matrices.append(matrix)
    for controller_filter in controller_filters:
        filter_input = rows[controller_filter.sensor]
        filter_inputs.append((len(state_matrices), controller_filter.B, filter_input))
        rows.append(
            {part: controller_filter.D * row for part, row in filter_input.items()}
            | {len(state_matrices): controller_filter.C}
        )
        state_matrices.append(controller_filter.A)
    first_states = np.cumsum([0, *(part.shape[0] for part in state_matrices)])
    total = int(first_states[-1])

    def expand(row):
        """A row on the states of some parts as a row on all states."""
        row_parts = [row.get(i, xp.zeros(part.shape[0])) for i, part in enumerate(state_matrices)]
        return xp.concatenate(row_parts)

    state_matrix = block_diag(*state_matrices)
    for i, column, row in filter_inputs:
        state_matrix = add_at(
            state_matrix,
            np.s_[first_states[i] : first_states[i + 1]],
            xp.outer(column, expand(row)),
        )
    filter_input = xp.stack([expand(row) for row in rows]) if rows else xp.zeros((0, total))
    command_matrix = set_at(
        xp.zeros((total, model.command_matrix.shape[1])),
        np.s_[: model.state_count],
        model.command_matrix,
    )
    augmented = eqx.tree_at(
        lambda r: (r.state_matrix, r.command_matrix), model, (state_matrix[None], command_matrix)
    )
    return augmented, filter_input


CLOCK_TOLERANCE_PERIODS = 1e-6  # a time this much before a sampling instant counts as at it
IDENTITY = np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]])  # a filter that changes nothing
MAX_READING = 1e30  # beyond it a reading is none
RANGE_TOLERANCE = 1e-6  # of the largest reading, in single precision

ROUNDED = (
    "what is rounded to a resolution jumps with it, so that it has no derivative: compare several"
    " of its values"
)

AnySensor = Sensor | VehicleSensor
Sections = Float[Array, "section 6 ..."] | None  # None: no digital filter
FilterState = Float[Array, "section 2 *batch"] | None


def sensor_sections(sensor: AnySensor, period: Float[Array, ""] | float) -> Sections:
    """Second-order sections of the sensor's digital filter, None if it has none.

    Designed for the sensor's own sampling period, or for `period` (s) if it has none. Raises
    ValueError if the filter's cutoff is not below half the sampling frequency.
    """
    if sensor.filter is None or sensor.filter.realisation != "digital":
        return None
    own = sensor.sampling_period
    return second_order_sections(sensor.filter, period if own is None else own)


def initial_filter_state(sensor: AnySensor, sections: Sections, value) -> FilterState:
    """State of the digital filter at rest under a constant true value (SI unit of the quantity)."""
    return None if sections is None else steady_filter_state(sections, to_reading(sensor, value))


def filtered_reading(
    sensor: AnySensor, sections: Sections, filter_state: FilterState, value, noise=None
) -> tuple[Float[Array, " *batch"], FilterState]:
    """Reading of a true value (both in the SI unit of the quantity), and the filter state after it.

    `noise` is a standard normal sample (see `noise_samples`), None for no noise. Values may have a
    batch axis, along which the numbers of the sensor are shared or differ.
    """
    reading = to_reading(sensor, value, noise)
    return (reading, None) if sections is None else filter_step(sections, filter_state, reading)


def to_reading(sensor: AnySensor, value, noise=None) -> Float[Array, "..."]:
    """Reading before the digital filter: offset, noise, range and resolution applied to the value.

    Derivatives are zero where the range clips; through rounding they are those of the unrounded
    reading (straight-through estimator), since those of the rounded one are zero. Derivatives by
    the resolution raise ValueError.
    """
    reading = value + sensor.offset
    if sensor.noise is not None and noise is not None:
        reading = reading + sensor.noise * noise
    if sensor.range is not None:
        reading = xp.clip(reading, sensor.range[0], sensor.range[1])
    if sensor.resolution is not None:
        step = not_differentiated(sensor.resolution, ROUNDED)
        rounded = step * xp.round(reading / step)
        reading = reading + stop_gradient(rounded - reading)
    return reading


def possible_readings(sensor: AnySensor) -> tuple[float, float]:
    """Lowest and highest sample that a sensor can give before its digital filter.

    What is not between them, or no number, is a missing reading.
    """
    if sensor.range is None:
        return -MAX_READING, MAX_READING
    low, high = (float(end) for end in concrete(sensor.range))
    beyond = RANGE_TOLERANCE * max(abs(low), abs(high))
    if sensor.resolution is not None:
        beyond += float(concrete(sensor.resolution)) / 2
    return low - beyond, high + beyond


def noise_samples(seed: int, sensors: int, samples: int) -> Float[Array, "sample sensor"]:
    """Standard normal samples, one a reading; a sensor's depend on the seed and its index only."""
    columns = [normal_samples(seed, sensor, samples) for sensor in range(sensors)]
    return xp.array(columns).reshape(sensors, samples).T


def needs_times(sensor: AnySensor) -> bool:
    """Whether readings depend on more than the simultaneous true value, hence on the times."""
    timed = sensor.filter, sensor.sampling_period, sensor.delay, sensor.dropout, sensor.jitter
    return any(part is not None for part in timed)


def sampled_readings(
    sensor: AnySensor,
    times: Float[Array, " time"],
    values: Float[Array, " time"],
    rates: Float[Array, " time"] | None,
    noise: Float[Array, " time"] | None = None,
    losses: Bool[Array, " time"] | None = None,
    late: Float[Array, " time"] | None = None,
) -> Float[Array, " time"]:
    """Latest reading of a sensor at ascending times (s), from the true values and their rates.

    Between the times the signal is the cubic Hermite interpolant of values and rates, linear
    without rates; before the first time it is constant. The sensor is sampled at the first time
    and every sampling period after it, or at each of the times if it has none. `noise` holds a
    standard normal sample for each reading, `losses` whether it is lost, so that the last one stays
    (at first the value at the first time), `late` how much older than the delay it is (s).

    Raises ValueError if a filter needs equally spaced times and these are not; if a digital filter
    would need readings between the times; if its cutoff is not below half the sampling frequency.
    """
    _check_times(sensor, times)
    spacing = (times[-1] - times[0]) / (times.shape[0] - 1)
    if sensor.filter is not None and sensor.filter.realisation == "analogue":
        values, rates = _apply_filter(sensor.filter, times, spacing, values, rates)
    sample_times, new_reading = times, None
    if sensor.sampling_period is not None:
        sample_index = xp.floor(
            (times - times[0]) / sensor.sampling_period + CLOCK_TOLERANCE_PERIODS
        )
        sample_times = times[0] + sensor.sampling_period * sample_index
        new_reading = xp.concatenate([xp.ones(1, bool), xp.diff(sample_index) > 0])
        number = xp.cumsum(new_reading) - 1
        noise, losses, late = (
            None if each is None else take(each, number) for each in (noise, losses, late)
        )
    sampled, delays = values, [delay for delay in (sensor.delay, late) if delay is not None]
    if sensor.sampling_period is not None or delays:
        signal_times = sample_times - sum(delays)
        sampled = evaluate_cubics(times, hermite_cubics(times, values, rates), signal_times)
    readings = to_reading(sensor, sampled, noise)
    sections = sensor_sections(sensor, spacing)
    if losses is not None:
        new_reading = ~losses if new_reading is None else new_reading & ~losses
        sections = IDENTITY if sections is None else sections
    if sections is None:
        return readings
    start = initial_filter_state(sensor, sections, values[0])
    before = to_reading(sensor, values[0])
    return filter_history(sections, start, readings, new_reading, before)


def _apply_filter(filter: Filter, times, spacing, values, rates):
    """Output of an analogue filter and its rate at equally spaced times, exact for cubics."""
    matrix, column, row, _ = analogue_state_space(filter)
    transition, input_matrix = c2d(matrix, column[:, None], spacing, degree=3)
    forced_response = hermite_cubics(times, values, rates) @ input_matrix[..., 0]

    def step(state, forced) -> Any:
        after = transition @ state + forced
        return after, after

    start = analogue_steady_state(filter, values[0])
    states = xp.concatenate([start[None], scan(step, start, forced_response)[1]])
    return states @ row, states @ (row @ matrix) + values * (row @ column)


def _check_times(sensor: AnySensor, times) -> None:
    if sensor.filter is None or not is_concrete(times):
        return
    steps = np.diff(concrete(times))
    equally_spaced = np.ptp(steps) <= CLOCK_TOLERANCE_PERIODS * np.mean(steps)
    sampling_period = sensor.sampling_period
    if not equally_spaced and (sampling_period is None or sensor.filter.realisation == "analogue"):
        raise ValueError(
            f"a filter of {sensor.filter.realisation} kind needs times at equal spacing; give it"
            " such times, or leave it out"
        )
    if (
        sensor.filter.realisation == "digital"
        and sampling_period is not None
        and is_concrete(sampling_period)
    ):
        max_spacing = float(np.max(steps))
        if float(concrete(sampling_period)) < (1 - CLOCK_TOLERANCE_PERIODS) * max_spacing:
            raise ValueError(
                f"its filter takes a reading every {float(concrete(sampling_period)):g} s, but"
                f" samples of the run are {max_spacing:g} s apart: save samples as often"
                " (run.sample_rate)"
            )


def sensor_readings(
    case: Case,
    modes: Modes,
    motion: Motion,
    times: Float[Array, " time"] | None = None,
    noisy: bool = False,
) -> Float[Array, "time sensor"]:
    """Readings of the sensors of a case (SI units) from the motion of its modes.

    The `times` (s) are needed for sensors whose readings depend on more than the present. `noisy`
    readings include noise, losses and random delays by the run's seed; predictions to compare with
    logs do without.

    Raises ValueError, naming the sensor, as `sampled_readings` does and for missing times.
    """
    samples = motion.coordinates.shape[0]
    random, noisy = noisy, noisy and any(sensor.noise is not None for sensor in case.sensors)
    noise = noise_samples(case.run.seed, len(case.sensors), samples) if noisy else None
    columns = []
    for i, sensor in enumerate(case.sensors):
        values = sensor_history(case, modes, motion, sensor)
        noise_of_sensor = None if noise is None else noise[:, i]
        if not needs_times(sensor):
            columns.append(to_reading(sensor, values, noise_of_sensor))
            continue
        if times is None:
            raise ValueError(
                f"sensors.{i} has a filter, a delay, a sampling period, dropout or jitter: its"
                " readings need times"
            )
        rates_of_change = None
        if not (sensor.has_feedthrough or sensor.bends):
            rates = motion._replace(coordinates=motion.rates, rates=motion.accelerations)
            rates_of_change = sensor_history(case, modes, rates, sensor)
        try:
            way = sent_readings(case.run.seed, i, sensor, samples) if random else (None, None)
            columns.append(
                sampled_readings(sensor, times, values, rates_of_change, noise_of_sensor, *way)
            )
        except ValueError as error:
            raise ValueError(f"sensors.{i}: {error}") from None
    return xp.array(columns).reshape(-1, samples).T


class VehicleMotion(NamedTuple):
    """Heights (m) or pitch angles (rad) of the bodies of vehicles, their rates and accelerations.

    Of all vehicles, then absorbers (see `Record.bodies`), measured from static equilibrium.
    """

    body_displacement: Float[Array, "time body"]
    body_velocity: Float[Array, "time body"]
    body_acceleration: Float[Array, "time body"]


def vehicle_readings(
    case: Case,
    motion: VehicleMotion,
    stroke: Float[Array, "time absorber"],
    times: Float[Array, " time"],
    noisy: bool = False,
) -> Float[Array, "time sensor"]:
    """Readings of the vehicle sensors of a case (SI units) at times (s), strokes in m.

    `noisy` readings include noise, losses and random delays by the run's seed.

    Raises ValueError, naming the sensor, as `sampled_readings` does.
    """
    loads, columns, samples = load_set(case), [], motion.body_displacement.shape[0]
    for i, sensor in enumerate(case.vehicle_sensors):
        values = _history(loads, sensor, motion, stroke)
        has_noise = noisy and sensor.noise is not None
        number = len(case.sensors) + i  # noise of its own, unlike that of the sensors on the beam
        noise = xp.asarray(normal_samples(case.run.seed, number, samples)) if has_noise else None
        if not needs_times(sensor):
            columns.append(to_reading(sensor, values, noise))
            continue
        try:
            way = sent_readings(case.run.seed, number, sensor, samples) if noisy else (None, None)
            columns.append(sampled_readings(sensor, times, values, None, noise, *way))
        except ValueError as error:
            raise ValueError(f"vehicle_sensors.{i}: {error}") from None
    return xp.array(columns).reshape(-1, samples).T


def relative_to_beam(
    case: Case, modes: Modes, of_bodies, of_modes
) -> Float[Array, "time absorber"]:
    """Motion of the bodies of absorbers less that of the beam there: displacements, or rates."""
    absorbers = case.absorbers
    if not absorbers:
        return xp.zeros((of_bodies.shape[0], 0))
    shapes = modes.shapes(xp.stack([one.position for one in absorbers]))
    return of_bodies[:, -len(absorbers) :] - of_modes @ shapes.T


def _history(
    loads: LoadSet, sensor: VehicleSensor, motion: VehicleMotion, stroke
) -> Float[Array, " time"]:
    """History of the quantity of a sensor: height u + x t of a point, or its rates; a stroke."""
    if sensor.absorber is not None:
        if sensor.quantity == "stroke":
            return stroke[:, sensor.absorber]
        own = getattr(motion, f"body_{sensor.quantity}")
        return own[:, own.shape[1] - loads.absorbers + sensor.absorber]
    history = getattr(motion, f"body_{sensor.quantity}")
    first = 0
    for group in loads.wheels.vehicles:
        dofs = len(group.names)
        if loads.load_of_wheel[group.first_wheel] == sensor.load:
            first += sensor.vehicle * dofs
            values = history[:, first + group.names.index(sensor.body)]
            pitch = f"{sensor.body} pitch"
            if pitch in group.names:
                values = values + sensor.position * history[:, first + group.names.index(pitch)]
            return values
        first += group.count * dofs
    raise ValueError(f"loads.{sensor.load} has no bodies")  # refused by `check_case`
