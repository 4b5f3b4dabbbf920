"""Readings of sensors while a force of one newton crosses a beam at constant speed.

    z' = A z - B psi(x(t)),    y = C z - D psi(x(t)) - G(x(t)),

with the modes psi at the force, the state space of the modal model, and the static correction G of
curvature, strain and section forces (see `jaxbeam.model.output_rows`). Velocities and
accelerations follow from these states, which are exact for a psi that is linear between fine steps;
other readings are static, with z' = 0: a heavy load changes the frequencies of the beam.
"""

import dataclasses
import functools

import numpy as np
import scipy.signal
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.flexibility import check_supported
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.output_rows import sensor_rows, static_correction
from jaxbeam.model.sensor_signals import needs_times, sampled_readings

STEPS_PER_CROSSING = 200
STEPS_PER_PERIOD = 12  # of the highest mode
MAX_STEPS = 20_000


class UnitForce:
    """Response of the sensors of a case, without its loads, for `duration` (s) after an entry.

    Sensors are ideal but for their analogue filters and delays. `frequencies` (Hz) are those of the
    modes. With `vibrating` all readings are dynamic, as those of velocities and accelerations.

    Raises ValueError for a beam that can move as a rigid body.
    """

    def __init__(self, case: Case, duration: float, vibrating: bool = False):
        empty = {"loads": (), "vehicle_sensors": (), "controller": None, "profile": None}
        bare = dataclasses.replace(case, **empty)
        model = modal_model(bare)
        check_supported(bare, model.modes.layout)
        outputs = sensor_rows(model, bare, bare.sensors)
        commands = len(case.actuators)
        inputs = np.zeros((model.state_count, commands + model.mode_count))
        inputs[model.rate_index, commands:] = np.eye(model.mode_count)
        C, D = outputs.of_system(model, model.A, inputs)
        self.model, self.duration = model, duration
        self.signals = [_signal(sensor) for sensor in bare.sensors]
        self.length = float(concrete(case.beam.length))
        self.correction = static_correction(model, bare, bare.sensors, outputs)
        self.frequencies = np.asarray(model.modes.frequencies)
        # In coordinates that decouple the states.
        self.poles, self.vectors = np.linalg.eig(model.A)
        self.inputs = np.linalg.solve(self.vectors, inputs[:, commands:])
        self.outputs, self.feedthrough = C @ self.vectors, D[:, commands:]
        self.vibrates = np.array([vibrating or order > 0 for order in outputs.time_derivatives])

    def modes(self, positions: Float[np.ndarray, " point"], count: int) -> tuple:
        """First frequency (Hz), shapes, ratios of frequencies, and damping ratios of modes."""
        own = np.flatnonzero(self.poles.imag > 1e-6 * np.abs(self.poles))
        own = own[np.argsort(np.abs(self.poles[own]))][:count]
        size = np.abs(self.poles[own])
        motion = self.vectors[self.model.coordinate_index][:, own]
        shapes = np.asarray(self.model.shapes(positions, (0,))[0]) @ motion
        largest = shapes[np.argmax(np.abs(shapes), axis=0), np.arange(own.size)]
        ratios, damping = size / size[0], -self.poles[own].real / size
        return float(size[0] / (2 * np.pi)), (shapes / largest).real, ratios, damping

    def readings(
        self, speed: float, since_entry: Float[np.ndarray, " time"]
    ) -> Float[np.ndarray, "time sensor"]:
        """Readings (SI units per newton) at times (s) since the entry; zero before it."""
        times, table = self._history(speed)
        columns = [np.interp(since_entry, times, column, left=0.0) for column in table.T]
        return np.stack(columns, axis=1)

    @functools.lru_cache(maxsize=256)  # noqa: B019  (as many as a search has speeds)
    def _history(self, speed: float):
        crossing = self.length / abs(speed)
        step = crossing / STEPS_PER_CROSSING
        if self.vibrates.any():
            step = min(step, 1 / (STEPS_PER_PERIOD * self.frequencies.max()))
        step = max(step, self.duration / MAX_STEPS)
        step = crossing / np.ceil(crossing / step)  # the exit is at the end of a step
        times = step * np.arange(int(np.ceil(self.duration / step)) + 2)
        on_beam = times < crossing * (1 + 1e-9)
        place = speed * times + (0.0 if speed > 0 else self.length)
        place = np.clip(place, 0.0, self.length)
        force = -np.where(on_beam[:, None], self.model.shapes(place, (0,))[0], 0.0)
        inputs = force @ self.inputs.T
        table = (-(inputs / self.poles) @ self.outputs.T).real
        if self.vibrates.any():
            states = driven(self.poles, inputs, step)
            moving = (states @ self.outputs.T).real + force @ self.feedthrough.T
            table = np.where(self.vibrates, moving, table)
        if self.correction is not None:
            influence = self.correction.influence.of_forces_at(place, place)
            table = table - np.where(on_beam[:, None], influence, 0.0)
        for i, sensor in enumerate(self.signals):
            if needs_times(sensor):
                table[:, i] = np.asarray(sampled_readings(sensor, times, table[:, i], None))
        return times, table


def _signal(sensor: Sensor) -> Sensor:
    """Sensor with only its analogue filter and delay, which act before sampling."""
    no_samples = {"offset": np.zeros(()), "noise": None, "range": None, "resolution": None}
    no_filter = {"filter": None} if sensor.has_digital_filter else {}
    return dataclasses.replace(sensor, sampling_period=None, **no_samples, **no_filter)


def driven(poles, inputs, step):
    """States z' = pole z + input from rest, exact for inputs that are linear within each step.

    Each input has its own pole, or all have one.
    """
    exponent = poles * step
    growth = np.exp(exponent)
    small = np.abs(exponent) < 1e-6
    safe = np.where(small, 1.0, exponent)
    first = np.where(small, 1 + exponent / 2, (growth - 1) / safe)
    second = np.where(small, 0.5 + exponent / 6, (first - 1) / safe)
    if np.ndim(poles) == 0:
        return scipy.signal.lfilter(
            [step * second, step * (first - second)], [1.0, -growth], inputs, axis=0
        )
    states = [
        scipy.signal.lfilter([step * b, step * (a - b)], [1.0, -factor], column)
        for a, b, factor, column in zip(first, second, growth, inputs.T, strict=True)
    ]
    return np.stack(states, axis=1)
