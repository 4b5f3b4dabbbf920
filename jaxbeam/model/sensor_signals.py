"""How a sensor turns what the beam does into what it reads.

In this order: an analogue filter smooths the signal; it is sampled, `delay` after the fact; offset
and noise are added; the reading is clipped to the range and rounded to the resolution; a digital
filter takes the samples. The signal, its clock and the analogue filter are continuous and belong
to the plant: `filtered_reading` is what happens at one sample, `sampled_readings` all of it for a whole history.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.filters import (
    Filter,
    analogue_state_space,
    analogue_steady_state,
    filter_history,
    filter_step,
    second_order_sections as filter_sections,
    steady_filter_state as filter_initial,
)
from jaxbeam.case.sensors import Sensor
from jaxbeam.numerics.discretisation import c2d, evaluate_cubics, hermite_cubics

CLOCK_TOLERANCE_PERIODS = (
    1e-6  # of a period: a sample this much before a tick of the clock is at the tick
)

Sections = Float[Array, "section 6 ..."] | None  # None: no digital filter
FilterState = Float[Array, "section 2 *lane"] | None


def sensor_sections(sensor: Sensor, period: Float[Array, ""] | float) -> Sections:
    """Sections of the sensor's digital filter, None if it has none.

    They are for its own sampling period if it has one, else for the given one (s). Raises
    ValueError if the filter's cutoff is not below half the sampling frequency.
    """
    if sensor.filter is None or sensor.filter.realisation != "digital":
        return None
    own = sensor.sampling_period
    return filter_sections(sensor.filter, period if own is None else own)


def initial_filter_state(sensor: Sensor, sections: Sections, value) -> FilterState:
    """Memory of a sensor that has long seen a constant value (SI unit of its quantity)."""
    return None if sections is None else filter_initial(sections, to_reading(sensor, value))


def filtered_reading(
    sensor: Sensor, sections: Sections, filter_state: FilterState, value, noise=None
) -> tuple[Float[Array, " *lane"], FilterState]:
    """One reading of a true value (both in the SI unit of the quantity), and the memory after it.

    `noise` is a standard normal sample (see `noise_samples`), None for no noise. Values may have
    lanes, which share the sensor or have numbers of their own in it along their last axis.
    """
    reading = to_reading(sensor, value, noise)
    return (reading, None) if sections is None else filter_step(sections, filter_state, reading)


def to_reading(sensor: Sensor, value, noise=None) -> Float[Array, "..."]:
    """The reading before the digital filter: offset, noise, range and resolution.

    Clipped readings have no derivative. Rounding is passed over by derivatives, which are those
    of the unrounded reading (straight through): its own are zero and say nothing.
    """
    reading = value + sensor.offset
    if sensor.noise is not None and noise is not None:
        reading = reading + sensor.noise * noise
    if sensor.range is not None:
        reading = jnp.clip(reading, sensor.range[0], sensor.range[1])
    if sensor.resolution is not None:
        rounded = sensor.resolution * jnp.round(reading / sensor.resolution)
        reading = reading + jax.lax.stop_gradient(rounded - reading)
    return reading


def noise_samples(seed: int, sensors: int, samples: int) -> Float[Array, "sample sensor"]:
    """Standard normal samples, one for each reading; the same for the same seed and sensor."""
    keys = [jax.random.fold_in(jax.random.key(seed), sensor) for sensor in range(sensors)]
    columns = [jax.random.normal(key, (samples,)) for key in keys]
    return jnp.array(columns).reshape(sensors, samples).T


def needs_times(sensor: Sensor) -> bool:
    """Tell whether readings depend on more than the true value at the same time."""
    return not (sensor.filter is None and sensor.sampling_period is None and sensor.delay is None)


def sampled_readings(
    sensor: Sensor,
    times: Float[Array, " time"],
    values: Float[Array, " time"],
    rates: Float[Array, " time"] | None,
    noise: Float[Array, " time"] | None = None,
) -> Float[Array, " time"]:
    """What a sensor shows at ascending times (s) when it sees these true values and rates.

    Between the times the signal is the cubic through values and rates, straight lines where no
    rates are given; before the first time it rests at the first value. The sensor reads at the
    first time and at every sampling period from there, at each of the times if it has none, and
    shows its latest reading; `noise` holds a standard normal sample for each reading.

    Raises ValueError if a filter needs times at equal spacing, which these are not; if a digital
    filter would need readings between the times; if its cutoff is not below half the sampling
    frequency.
    """
    _check_times(sensor, times)
    spacing = (times[-1] - times[0]) / (times.shape[0] - 1)
    if sensor.filter is not None and sensor.filter.realisation == "analogue":
        values, rates = _apply_filter(sensor.filter, times, spacing, values, rates)
    sample_times, new_reading = times, None
    if sensor.sampling_period is not None:
        sample_index = jnp.floor(
            (times - times[0]) / sensor.sampling_period + CLOCK_TOLERANCE_PERIODS
        )
        sample_times = times[0] + sensor.sampling_period * sample_index
        new_reading = jnp.concatenate([jnp.ones(1, bool), jnp.diff(sample_index) > 0])
        noise = None if noise is None else noise[jnp.cumsum(new_reading) - 1]
    sampled = values
    if sensor.sampling_period is not None or sensor.delay is not None:
        signal_times = sample_times if sensor.delay is None else sample_times - sensor.delay
        sampled = evaluate_cubics(times, hermite_cubics(times, values, rates), signal_times)
    readings = to_reading(sensor, sampled, noise)
    sections = sensor_sections(sensor, spacing)
    if sections is None:
        return readings
    return filter_history(
        sections, initial_filter_state(sensor, sections, values[0]), readings, new_reading
    )


def _apply_filter(filter: Filter, times, spacing, values, rates):
    """Output of an analogue filter and its rate, at equally spaced times."""
    matrix, column, row, _ = analogue_state_space(filter)
    transition, input_matrix = c2d(matrix, column[:, None], spacing, degree=3)
    forced_response = hermite_cubics(times, values, rates) @ input_matrix[..., 0]

    def step(state, forced) -> Any:
        after = transition @ state + forced
        return after, after

    start = analogue_steady_state(filter, values[0])
    states = jnp.concatenate([start[None], jax.lax.scan(step, start, forced_response)[1]])
    return states @ row, states @ (row @ matrix) + values * (row @ column)


def _check_times(sensor: Sensor, times) -> None:
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
                f"its filter takes a reading every {float(concrete(sampling_period)):g} s, but samples of the run"
                f" are {max_spacing:g} s apart: save samples as often (run.sample_rate)"
            )
