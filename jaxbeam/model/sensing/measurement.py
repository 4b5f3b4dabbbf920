"""Readings of the sensors from the motion of the modes."""

from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.model.modes import Modes
from jaxbeam.model.sensing.output_rows import sensor_history
from jaxbeam.model.sensing.sensor_signals import (
    needs_times,
    noise_samples,
    sampled_readings,
    to_reading,
)
from jaxbeam.model.sensing.transmission import sent_readings
from jaxbeam.model.static_correction import Motion
from jaxbeam.runtime.arrays import Array, xp


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
