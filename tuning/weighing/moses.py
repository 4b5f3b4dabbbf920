"""Moses' method: axle forces from influence lines, by linear least squares (Moses 1979).

With the positions x_a(t) of the axles and the influence lines I_s of the sensors,

    y_s(t) = sum_a P_a I_s(x_a(t)) + c_s,

with an offset c_s of each sensor. What the static forces P_a do not explain, such as the vibration
of bridge and vehicle, is residual.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from tuning.fit.uncertainty.covariance import t_quantile
from tuning.weighing.dynamic_forces import dynamic_errors, dynamic_waves, white_noise
from tuning.weighing.influence_lines import AxleGeometry, InfluenceLines


@dataclasses.dataclass(frozen=True, eq=False)
class MosesFit:
    """Axle forces (N) with their covariance, at a geometry; residuals by sensor.

    The covariance is that of `dynamic_forces`, for which the residuals are due to dynamic wheel
    forces, `dynamic_share` of the static ones (standard deviation).
    """

    geometry: AxleGeometry
    forces: Float[np.ndarray, " axle"]
    covariance: Float[np.ndarray, "axle axle"]
    residuals: Float[np.ndarray, "time sensor"]
    dynamic_share: float
    degrees_of_freedom: float

    @property
    def errors(self) -> Float[np.ndarray, " axle"]:
        """Standard errors of the axle forces (N)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def gross_weight(self) -> tuple[float, float]:
        """Sum of the axle forces and its standard error (N)."""
        return float(self.forces.sum()), float(np.sqrt(self.covariance.sum()))

    @property
    def intervals(self) -> Float[np.ndarray, "axle 2"]:
        """95 % intervals of the axle forces (N)."""
        half = t_quantile(self.degrees_of_freedom) * self.errors
        return np.stack([self.forces - half, self.forces + half], axis=1)


def moses(
    lines: InfluenceLines,
    geometry: AxleGeometry,
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
    valid: np.ndarray | None = None,
    found: bool = False,
) -> MosesFit:
    """Axle forces by Moses' method from the readings (SI units) of a crossing.

    The geometry is known, or was `found` in the same readings: its errors then are part of those of
    the forces. Raises ValueError if the axles are on the beam at too few samples.
    """
    valid = np.ones(readings.shape, bool) if valid is None else valid
    columns = lines.at(geometry.positions(times))  # (time, axle, sensor)
    axles, sensors = columns.shape[1:]
    if valid.sum() < axles + sensors + 2:
        raise ValueError(f"{axles} axles need more samples than {int(valid.sum())}")
    spread = np.where(valid, readings, np.nan)
    noise = np.maximum(np.nanstd(spread, axis=0), 1e-300)
    for _ in range(2):
        weights = valid / noise
        rows = _with_offsets(columns, weights)
        sizes = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        target = (readings * weights).T.ravel()
        solution = np.linalg.lstsq(rows / sizes, target, rcond=None)[0] / sizes
        fitted = np.einsum("tas,a->ts", columns, solution[:axles]) + solution[axles:]
        residuals = readings - fitted
        share = 1 - (axles + sensors) / valid.sum()
        squares = np.sum(valid * residuals**2, axis=0) / np.maximum(valid.sum(axis=0), 1) / share
        noise = np.sqrt(np.maximum(squares, 1e-18 * noise**2))
    waves = dynamic_waves(lines, geometry, solution[:axles], times)
    parts = [columns]
    if found:
        parts.append(_geometry_slopes(lines, geometry, times, solution[:axles]))
    shifts = np.broadcast_to(np.eye(sensors), (times.size, sensors, sensors))
    jacobian = np.concatenate([*parts, shifts], axis=1)
    errors = dynamic_errors(jacobian, waves, residuals, white_noise(readings, valid), weights)
    covariance = errors.covariance[:axles, :axles]
    share, freedom = errors.share, errors.degrees_of_freedom
    return MosesFit(geometry, solution[:axles], covariance, residuals, share, freedom)


def _geometry_slopes(lines, geometry: AxleGeometry, times, forces):
    """Derivatives (time, number, sensor) by speed, entry time and distances, by differences."""
    slopes = []
    numbers = np.array([geometry.speed, geometry.entry_time, *geometry.offsets[1:]])
    for i in range(numbers.size):
        step = 1e-3 * (geometry.length / abs(geometry.speed) if i == 1 else max(abs(numbers[i]), 1))
        readings = []
        for sign in (1, -1):
            moved = numbers + sign * step * (np.arange(numbers.size) == i)
            offsets = np.append(0.0, moved[2:])
            at = AxleGeometry(moved[0], moved[1], offsets, geometry.length)
            readings.append(np.einsum("tas,a->ts", lines.at(at.positions(times)), forces))
        slopes.append((readings[0] - readings[1]) / (2 * step))
    return np.stack(slopes, axis=1)


def _with_offsets(columns, weights):
    """Rows (sensor by sensor) of the linear problem: axles, then the offsets of the sensors."""
    axles, sensors = columns.shape[1:]
    blocks = []
    for s in range(sensors):
        offsets = np.zeros((columns.shape[0], sensors))
        offsets[:, s] = 1.0
        blocks.append(np.hstack([columns[:, :, s], offsets]) * weights[:, s, None])
    return np.vstack(blocks)
