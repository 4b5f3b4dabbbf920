"""How a sensor turns what the beam does into what it reads.

In this order: an analogue filter smooths the signal; it is sampled, `delay` after the fact; offset
and noise are added; the reading is clipped to the range and rounded to the resolution; a digital
filter takes the samples. The signal, its clock and the analogue filter are continuous and belong
to the plant: `read` is what happens at one sample, `sense` all of it for a whole history.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.fields import is_known, known
from jaxbeam.case.filters import (
    Filter,
    analogue,
    analogue_initial,
    filter_history,
    filter_step,
    initial as filter_initial,
    sections as filter_sections,
)
from jaxbeam.case.sensors import Sensor
from jaxbeam.numerics.discretisation import c2d, evaluate_cubics, hermite_cubics

ROUNDING = 1e-6  # of a period: a sample this much before a tick of the clock is at the tick

Sections = Float[Array, "section 6 ..."] | None  # None: no digital filter
Memory = Float[Array, "section 2 *lane"] | None


def design(sensor: Sensor, period: Float[Array, ""] | float) -> Sections:
    """Sections of the sensor's digital filter, None if it has none.

    They are for its own sampling period if it has one, else for the given one (s). Raises
    ValueError if the filter's cutoff is not below half the sampling frequency.
    """
    if sensor.filter is None or sensor.filter.realisation != "digital":
        return None
    own = sensor.sampling_period
    return filter_sections(sensor.filter, period if own is None else own)


def init(sensor: Sensor, sections: Sections, value) -> Memory:
    """Memory of a sensor that has long seen a constant value (SI unit of its quantity)."""
    return None if sections is None else filter_initial(sections, convert(sensor, value))


def read(
    sensor: Sensor, sections: Sections, memory: Memory, value, noise=None
) -> tuple[Float[Array, " *lane"], Memory]:
    """One reading of a true value (both in the SI unit of the quantity), and the memory after it.

    `noise` is a standard normal sample (see `noise_samples`), None for no noise. Values may have
    lanes, which share the sensor or have numbers of their own in it along their last axis.
    """
    reading = convert(sensor, value, noise)
    return (reading, None) if sections is None else filter_step(sections, memory, reading)


def convert(sensor: Sensor, value, noise=None) -> Float[Array, "..."]:
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


def sense(
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
        values, rates = _smooth(sensor.filter, times, spacing, values, rates)
    ticks, fresh = times, None
    if sensor.sampling_period is not None:
        number = jnp.floor((times - times[0]) / sensor.sampling_period + ROUNDING)
        ticks = times[0] + sensor.sampling_period * number
        fresh = jnp.concatenate([jnp.ones(1, bool), jnp.diff(number) > 0])
        noise = None if noise is None else noise[jnp.cumsum(fresh) - 1]
    seen = values
    if sensor.sampling_period is not None or sensor.delay is not None:
        late = ticks if sensor.delay is None else ticks - sensor.delay
        seen = evaluate_cubics(times, hermite_cubics(times, values, rates), late)
    readings = convert(sensor, seen, noise)
    sections = design(sensor, spacing)
    if sections is None:
        return readings
    return filter_history(sections, init(sensor, sections, values[0]), readings, fresh)


def _smooth(filter: Filter, times, spacing, values, rates):
    """Output of an analogue filter and its rate, at equally spaced times."""
    matrix, column, row, _ = analogue(filter)
    drift, push = c2d(matrix, column[:, None], spacing, degree=3)
    driven = hermite_cubics(times, values, rates) @ push[..., 0]

    def step(state, drive) -> Any:
        after = drift @ state + drive
        return after, after

    start = analogue_initial(filter, values[0])
    states = jnp.concatenate([start[None], jax.lax.scan(step, start, driven)[1]])
    return states @ row, states @ (row @ matrix) + values * (row @ column)


def _check_times(sensor: Sensor, times) -> None:
    if sensor.filter is None or not is_known(times):
        return
    steps = np.diff(known(times))
    even = np.ptp(steps) <= ROUNDING * np.mean(steps)
    own = sensor.sampling_period
    if not even and (own is None or sensor.filter.realisation == "analogue"):
        raise ValueError(
            f"a filter of {sensor.filter.realisation} kind needs times at equal spacing; give it"
            " such times, or leave it out"
        )
    if sensor.filter.realisation == "digital" and own is not None and is_known(own):
        longest = float(np.max(steps))
        if float(known(own)) < (1 - ROUNDING) * longest:
            raise ValueError(
                f"its filter takes a reading every {float(known(own)):g} s, but samples of the run"
                f" are {longest:g} s apart: save samples as often (run.sample_rate)"
            )
