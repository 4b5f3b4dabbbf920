"""Smallest and largest values of what each sensor measures."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxtyping import Float

from jaxbeam.case.sensors import Sensor
from jaxbeam.runtime.arrays import Array, set_at, take, xp


class Extremes(NamedTuple):
    """Smallest and largest value of the quantity of each sensor, in its unit, and times (s)."""

    smallest: Float[Array, " sensor"]
    smallest_time: Float[Array, " sensor"]
    largest: Float[Array, " sensor"]
    largest_time: Float[Array, " sensor"]


def sensor_extremes(
    sensors: Sequence[Sensor],
    times: Float[Array, " time"],
    values: Float[Array, "time sensor"],
    peak_deflection: Float[Array, " sensor"],
    peak_time: Float[Array, " sensor"],
) -> Extremes:
    """Extremes of the samples of each sensor; NaN from NaN.

    Peaks of the absolute deflection (m) and their times (s), which lie between samples, replace the
    extreme of a sensor of deflections on their side.
    """
    parts = [[xp.zeros(len(sensors))] * 2 for _ in range(2)]
    for i, sensor in enumerate(sensors):
        history = values[:, i]
        for side, sign in enumerate((-1.0, 1.0)):
            index = xp.argmax(sign * history)
            value, time = take(history, index), take(times, index)
            if sensor.quantity == "deflection":
                at_peak = xp.interp(peak_time[i], times, history)
                beyond = (sign * at_peak > 0) & (peak_deflection[i] >= sign * value)
                value = xp.where(beyond, sign * peak_deflection[i], value)
                time = xp.where(beyond, peak_time[i], time)
            parts[side] = [set_at(parts[side][0], i, value), set_at(parts[side][1], i, time)]
    return Extremes(*parts[0], *parts[1])
