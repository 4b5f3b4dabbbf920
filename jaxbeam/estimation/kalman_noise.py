"""Noise of the plant and of the readings in Kalman filters: settings, and their checks."""

import math

from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.estimator import AbstractEstimator
from jaxbeam.case.fields import POSITIVE, concrete, count, is_concrete, number
from jaxbeam.estimation.sampled_plant import PERIOD_ROUNDING
from jaxbeam.model.state_space import Plant
from jaxbeam.runtime.arrays import Array, xp


class AbstractKalmanEstimator(AbstractEstimator):
    """Settings that Kalman filters share: noise of plant and readings, and delays of sensors."""

    process_noise: Float[Array, " *mode"] = number(
        "N^2 s/kg", "intensity of the white force on each mode", POSITIVE
    )
    measurement_noise: Float[Array, " *sensor"] | None = number(
        "unit of quantity",
        "standard deviation of readings; that of the sensors if left out",
        POSITIVE,
        default=None,
    )
    max_delay_periods: int = count(
        "largest delay of a sensor, in periods, rounded up", default=1, kw_only=True
    )

    def sampled_noise_error(self, case: Case) -> str | None:
        """Error of noise and delays of readings at samples, or None."""
        missing = missing_noise_error(case) if self.measurement_noise is None else None
        return missing or delay_error(case, self.max_delay_periods)

    def size_error(self, sizes: dict[str, int]) -> str | None:
        """Error of a setting that has neither one entry nor as many as its size, or None."""
        for name, size in sizes.items():
            value = getattr(self, name)
            if value is not None and value.shape not in ((), (size,)):
                return f"{name} must be one number or {size}, not {value.shape[0]}"
        return None


def modal_noise_intensity(
    plant: Plant, process_noise: Float[Array, " *mode"]
) -> Float[Array, "state state"]:
    """Intensity of the white noise in the rates of the states, (unit of each)^2 s.

    Forces of intensity `process_noise` (N^2 s/kg) act on the mass-normalised modes.
    """
    modes = plant.coordinate_scale.shape[0]
    force = process_noise * plant.coordinate_scale**2
    actuator_intensity = xp.zeros(plant.modal_model.state_count - 2 * modes)
    return xp.diag(xp.concatenate([xp.zeros(modes), force, actuator_intensity]))


def reading_variance(
    plant: Plant, measurement_noise: Float[Array, " *sensor"] | None
) -> Float[Array, " sensor"]:
    """Variance of the noise of each reading, in its unit squared; that of the sensors if None."""
    sensors = plant.case.sensors
    if measurement_noise is None:
        return xp.stack([sensor.noise_variance for sensor in sensors])
    return xp.broadcast_to(measurement_noise**2, (len(sensors),))


def missing_noise_error(case: Case) -> str | None:
    """Error of a filter whose readings have the noise of the sensors, if one has none, or None."""
    for i, sensor in enumerate(case.sensors):
        if sensor.noise is None or (is_concrete(sensor.noise) and concrete(sensor.noise) == 0):
            return f"measurement_noise must be given, as sensors.{i} has no noise"
    return None


def delay_error(case: Case, max_delay_periods: int) -> str | None:
    """Error if a sensor is delayed by more periods of the controller, or None."""
    period = case.controller.period
    for i, sensor in enumerate(case.sensors):
        if sensor.delay is None or not (is_concrete(sensor.delay) and is_concrete(period)):
            continue
        delay_periods = math.ceil(concrete(sensor.delay) / concrete(period) - PERIOD_ROUNDING)
        if delay_periods > max_delay_periods:
            return (
                f"max_delay_periods must be at least {delay_periods}, the periods of"
                f" sensors.{i}.delay"
            )
    return None
