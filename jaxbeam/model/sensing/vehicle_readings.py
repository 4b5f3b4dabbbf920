"""Readings of the sensors on vehicles from the motion of their bodies."""

from typing import NamedTuple

from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.loads.planar.sensors import VehicleSensor
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.sensing.sensor_signals import needs_times, sampled_readings, to_reading
from jaxbeam.model.sensing.transmission import sent_readings
from jaxbeam.numerics.normal_samples import normal_samples
from jaxbeam.runtime.arrays import Array, xp


class VehicleMotion(NamedTuple):
    """Heights (m) or pitch angles (rad) of the bodies of vehicles, their rates and accelerations.

    Of all vehicles, one after the other (see `Record.bodies`), measured from static equilibrium.
    """

    body_displacement: Float[Array, "time body"]
    body_velocity: Float[Array, "time body"]
    body_acceleration: Float[Array, "time body"]


def vehicle_readings(
    case: Case, motion: VehicleMotion, times: Float[Array, " time"], noisy: bool = False
) -> Float[Array, "time sensor"]:
    """Readings of the vehicle sensors of a case (SI units) at times (s).

    `noisy` readings include noise, losses and random delays by the run's seed.

    Raises ValueError, naming the sensor, as `sampled_readings` does.
    """
    loads, columns, samples = load_set(case), [], motion.body_displacement.shape[0]
    for i, sensor in enumerate(case.vehicle_sensors):
        values = _history(loads, sensor, motion)
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


def _history(loads: LoadSet, sensor: VehicleSensor, motion: VehicleMotion) -> Float[Array, " time"]:
    """History of the quantity of a sensor: height u + x t of a point, or its rates."""
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
