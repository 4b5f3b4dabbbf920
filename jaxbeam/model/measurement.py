"""What would be measured on a beam whose modes move in a given way."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.case import Case
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.model.modes import Modes
from jaxbeam.model.sensor_signals import needs_times, noise_samples, sampled_readings, to_reading


def quantity_history(
    modes: Modes, modal_histories, x, quantity: str, fibre_distance
) -> Float[Array, "time ..."]:
    """History of a quantity at places x (m), when coordinates, rates and accelerations are those.

    Raises ValueError for a quantity that there is not, and for strain without `fibre_distance` (m).
    """
    if quantity not in QUANTITIES:
        raise ValueError(f"no quantity {quantity!r}; there are {', '.join(QUANTITIES)}")
    if quantity == "strain" and fibre_distance is None:
        raise ValueError("strain needs fibre_distance, the height above the neutral axis in m")
    derivative = {"slope": 1, "strain": 2}.get(quantity, 0)
    amplitudes = modal_histories[{"velocity": 1, "acceleration": 2}.get(quantity, 0)]
    history = jnp.tensordot(amplitudes, modes.shapes(x, derivative), axes=[1, -1])
    return -fibre_distance * history if quantity == "strain" else history


def sensor_readings(
    case: Case,
    modes: Modes,
    coordinates: Float[Array, "time mode"],
    rates: Float[Array, "time mode"],
    accelerations: Float[Array, "time mode"],
    times: Float[Array, " time"] | None = None,
    noisy: bool = False,
) -> Float[Array, "time sensor"]:
    """What the sensors of a case read when its modes move so (SI units; see `sensing`).

    Only sensors with a filter, a delay or a sampling period ask for the times (s). Noise is drawn
    by the run's seed if `noisy`; predictions to be held against logs leave it out.

    Raises ValueError, naming the sensor, for what `sensing.sampled_readings` refuses and for missing times.
    """
    modal_histories = coordinates, rates, accelerations
    samples = coordinates.shape[0]
    noisy = noisy and any(sensor.noise is not None for sensor in case.sensors)
    noise = noise_samples(case.run.seed, len(case.sensors), samples) if noisy else None
    columns = []
    for i, sensor in enumerate(case.sensors):
        channel = sensor.position, sensor.quantity, sensor.fibre_distance
        values = quantity_history(modes, modal_histories, *channel)
        noise_of_sensor = None if noise is None else noise[:, i]
        if not needs_times(sensor):
            columns.append(to_reading(sensor, values, noise_of_sensor))
            continue
        if times is None:
            raise ValueError(f"sensors.{i} has a filter, delay or clock: its readings need times")
        rates_of_change = None
        if sensor.quantity != "acceleration":
            rates_of_change = quantity_history(modes, modal_histories[1:], *channel)
        try:
            columns.append(
                sampled_readings(sensor, times, values, rates_of_change, noise_of_sensor)
            )
        except ValueError as error:
            raise ValueError(f"sensors.{i}: {error}") from None
    return jnp.array(columns).reshape(-1, samples).T
