"""Smallest and largest values of what each sensor measures, between samples too."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.sensors import Sensor
from jaxbeam.integrator.peaks.running_peaks import Peaks
from jaxbeam.runtime.arrays import Array, xp


class Extremes(NamedTuple):
    """Smallest and largest value of the quantity of each sensor, in its unit, and times (s).

    The beam starts at rest, so that zero is among the values.
    """

    smallest: Float[Array, " sensor"]
    smallest_time: Float[Array, " sensor"]
    largest: Float[Array, " sensor"]
    largest_time: Float[Array, " sensor"]


def monitored_sensors(sensors: Sequence[Sensor]) -> tuple[Sensor, ...]:
    """Deflections at all sensors, then the other quantities of those that measure others."""
    others = (sensor for sensor in sensors if sensor.quantity != "deflection")
    return *(Sensor(sensor.position) for sensor in sensors), *others


def own_outputs(sensors: Sequence[Sensor]) -> Int[np.ndarray, " sensor"]:
    """Index of the quantity of each sensor among those of `monitored_sensors`."""
    others = np.array([sensor.quantity != "deflection" for sensor in sensors], int)
    return np.where(others, len(sensors) + np.cumsum(others) - 1, np.arange(len(sensors)))


def sensor_extremes(sensors: Sequence[Sensor], peaks: Peaks) -> tuple[Extremes, Peaks]:
    """Extremes at the sensors, and peaks of the absolute deflection there.

    `peaks` are those of `monitored_sensors` in one run: the largest of each, then the largest of
    its negative.
    """
    up, down = xp.split(peaks.peak_deflection, 2)
    up_time, down_time = xp.split(peaks.peak_time, 2)
    index, every = own_outputs(sensors), slice(0, len(sensors))
    if np.array_equal(index, np.arange(len(sensors))):
        index = every  # a slice, for which programs are smaller
    extremes = Extremes(-down[index], down_time[index], up[index], up_time[index])
    is_up = up[every] >= down[every]
    deflection = xp.where(is_up, up[every], down[every])
    time = xp.where(is_up, up_time[every], down_time[every])
    return extremes, peaks._replace(peak_deflection=deflection, peak_time=time)
