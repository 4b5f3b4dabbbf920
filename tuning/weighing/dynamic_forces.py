"""Dynamic forces of wheels from responses to unit forces.

    z' = A z - B psi(x(t)),    y = C z - D psi(x(t)) - G(x(t)),

with the modes psi at the force, the state space of the modal model, and the static correction G of
curvature, strain and section forces (see `jaxbeam.model.sensing.corrected_rows`). Velocities and
accelerations follow from these states, which are exact for a psi that is linear between fine steps;
other readings are static, with z' = 0: a heavy load changes the frequencies of the beam.

Each axle force varies about its static value P_a as a random process of standard deviation d P_a,
with as much power in each octave from body bounce to axle hop. It changes the readings by d B w,
where the columns of B are readings of P_a cos(2 pi f t) and P_a sin(2 pi f t) on the influence
lines, and w is white. With noise of standard deviation s, the readings have the covariance
C = s^2 + d^2 B B', and parameters fitted by least squares with the Jacobian J have

    (J'J)^-1 J' C J (J'J)^-1.

The share d follows from the residuals r = (1 - H) e, H = J (J'J)^-1 J': their power is that of the
noise, and d^2 |(1 - H) B|^2.
"""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
import scipy.signal
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.flexibility import check_supported
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.sensing.corrected_rows import static_correction
from jaxbeam.model.sensing.output_rows import sensor_rows
from jaxbeam.model.sensing.sensor_signals import needs_times, sampled_readings
from tuning.fit.uncertainty.covariance import t_quantile

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
        # In coordinates in which each state is on its own.
        self.poles, vectors = np.linalg.eig(model.A)
        self.inputs = np.linalg.solve(vectors, inputs[:, commands:])
        self.outputs, self.feedthrough = C @ vectors, D[:, commands:]
        self.vibrates = np.array([vibrating or order > 0 for order in outputs.time_derivatives])

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
            states = _driven(self.poles, inputs, step)
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
    """The sensor with its analogue filter and delay alone: what acts before its samples."""
    no_samples = {"offset": np.zeros(()), "noise": None, "range": None, "resolution": None}
    no_filter = {"filter": None} if sensor.has_digital_filter else {}
    return dataclasses.replace(sensor, sampling_period=None, **no_samples, **no_filter)


def _driven(poles, inputs, step):
    """States z' = pole z + input from rest, exact for inputs that are linear within each step."""
    exponent = poles * step
    growth = np.exp(exponent)
    small = np.abs(exponent) < 1e-6
    safe = np.where(small, 1.0, exponent)
    first = np.where(small, 1 + exponent / 2, (growth - 1) / safe)
    second = np.where(small, 0.5 + exponent / 6, (first - 1) / safe)
    states = [
        scipy.signal.lfilter([step * b, step * (a - b)], [1.0, -factor], column)
        for a, b, factor, column in zip(first, second, growth, inputs.T, strict=True)
    ]
    return np.stack(states, axis=1)


FREQUENCIES = np.geomspace(0.7, 16.0, 14)  # Hz


class DynamicErrors(NamedTuple):
    """Covariance of fitted parameters, the share d of the dynamic wheel forces, and its freedom."""

    covariance: Float[np.ndarray, "parameter parameter"]
    share: float
    degrees_of_freedom: float

    @property
    def errors(self) -> Float[np.ndarray, " parameter"]:
        """Standard errors of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def half_widths(self) -> Float[np.ndarray, " parameter"]:
        """Half widths of the 95 % intervals."""
        return t_quantile(self.degrees_of_freedom) * self.errors


def dynamic_readings(
    columns: Float[np.ndarray, "time axle sensor"],
    forces: Float[np.ndarray, " axle"],
    times: Float[np.ndarray, " time"],
) -> Float[np.ndarray, "time wave sensor"]:
    """Readings B of the waves of dynamic axle forces, from those of unit forces (`columns`)."""
    angle = 2 * np.pi * FREQUENCIES * times[:, None]
    waves = np.concatenate([np.cos(angle), np.sin(angle)], axis=1) / np.sqrt(FREQUENCIES.size)
    table = waves[:, :, None, None] * (columns * forces[:, None])[:, None]
    return table.reshape(times.size, -1, columns.shape[2])


def dynamic_errors(
    jacobian: Float[np.ndarray, "time parameter sensor"],
    waves: Float[np.ndarray, "time wave sensor"],
    residuals: Float[np.ndarray, "time sensor"],
    noise: Float[np.ndarray, " sensor"],
    weights: Float[np.ndarray, "time sensor"],
) -> DynamicErrors:
    """Errors of parameters that were fitted by least squares with `weights` of the readings.

    `noise` is the standard deviation of white noise of each sensor; weights are zero for samples
    that do not count.
    """

    def stacked(table):
        return np.concatenate([table[:, :, s] * weights[:, s, None] for s in range(len(noise))])

    J, B = stacked(jacobian), stacked(waves)
    r = (residuals * weights).T.ravel()
    white = (weights * noise).T.ravel()
    sizes = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    basis, triangle = np.linalg.qr(J / sizes)
    inside, outside = basis.T @ B, B - basis @ (basis.T @ B)
    power = np.linalg.svd(outside, compute_uv=False) ** 2
    noise_power = np.sum(white**2) - np.sum((basis * white[:, None]) ** 2)
    excess = max(float(r @ r - noise_power), 0.0) / max(power.sum(), 1e-300)
    of_noise = (basis * white[:, None] ** 2).T @ basis
    middle = of_noise + excess * inside @ inside.T
    inverse = np.linalg.pinv(triangle)
    covariance = inverse @ middle @ inverse.T / np.outer(sizes, sizes)
    freedom = float(power.sum() ** 2 / max(np.sum(power**2), 1e-300))
    samples = float(np.sum(weights > 0)) - J.shape[1]
    dominated = excess * power.sum() > noise_power
    return DynamicErrors(
        covariance, float(np.sqrt(excess)), max(freedom if dominated else samples, 1.0)
    )


def degrees_of_freedom(waves: Float[np.ndarray, "time wave sensor"]) -> float:
    """Degrees of freedom of dynamic wheel forces with these waves: their share of equal ones."""
    scale = np.maximum(waves.std(axis=(0, 1)), 1e-300)
    rows = (waves / scale).transpose(1, 0, 2).reshape(waves.shape[1], -1)
    power = np.linalg.svd(rows, compute_uv=False) ** 2
    return float(power.sum() ** 2 / max(np.sum(power**2), 1e-300))


def white_noise(
    readings: Float[np.ndarray, "time sensor"], valid: np.ndarray
) -> Float[np.ndarray, " sensor"]:
    """Standard deviation of white noise by sensor, from second differences of the readings."""
    second = np.abs(np.diff(readings, 2, axis=0))
    counted = valid[2:] & valid[1:-1] & valid[:-2]
    levels = [np.median(second[has, s]) if has.any() else 0.0 for s, has in enumerate(counted.T)]
    return np.maximum(1.4826 * np.array(levels) / np.sqrt(6), 1e-9 * readings.std(axis=0))
