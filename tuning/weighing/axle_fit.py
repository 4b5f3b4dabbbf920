"""Axle forces, distances and speed by generalised least squares.

With the readings u_s (`InfluenceLines.crossing`) of a force of one newton on axle a, those of a
crossing are

    y_s(t) = sum_a P_a u_s(t; v, t_0, x_a) + c_s + e_s(t),   cov e = S + d^2 B B' + E E'.

S is the white noise of the sensors; the columns of B are readings of dynamic wheel forces
(`dynamic_forces`), d their share of the static ones, and those of E are what the errors of
calibrated influence lines make of the axle forces. The share d has the greatest restricted
likelihood (Patterson and Thompson 1971, DOI 10.1093/biomet/58.3.545). The covariance of all
parameters is that of the weighted problem, times what the residuals exceed this noise by.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from tuning.fit.uncertainty.covariance import t_quantile
from tuning.weighing.dynamic_forces import dynamic_readings, white_noise
from tuning.weighing.influence_lines import AxleGeometry, InfluenceLines
from tuning.weighing.search import MAX_GAP, MIN_AXLE_SHARE, MIN_GAP

ROUNDS = 3  # of weights and parameters in turn
SHARES = 1e-4, 0.3  # of dynamic wheel forces in the static ones; worst roads have 0.3
STEPS = 1e-4  # of lengths and times in differences, of the bridge and its crossing


@dataclasses.dataclass(frozen=True, eq=False)
class AxleFit:
    """Axles on a bridge with the covariance of their forces (N), speed, entry time and offsets.

    `covariance` is that of forces, speed (m/s), entry time (s) and offsets (m) behind the first
    axle, in this order; `dynamic_share` is d. `deviance` is minus twice the log-likelihood but for
    a constant of the readings, at the best parameters.
    """

    geometry: AxleGeometry
    forces: Float[np.ndarray, " axle"]
    covariance: Float[np.ndarray, "parameter parameter"]
    dynamic_share: float
    degrees_of_freedom: float
    deviance: float
    fitted: Float[np.ndarray, "time sensor"]

    @property
    def is_plausible(self) -> bool:
        """Whether no axle is so light that it stands for something else."""
        return bool(self.forces.min() > MIN_AXLE_SHARE * self.forces.sum())

    @property
    def errors(self) -> Float[np.ndarray, " parameter"]:
        """Standard errors of forces, speed, entry time and offsets."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def values(self) -> Float[np.ndarray, " parameter"]:
        """Forces, speed, entry time and offsets."""
        at = self.geometry
        return np.concatenate([self.forces, [at.speed, at.entry_time], at.offsets[1:]])

    @property
    def half_widths(self) -> Float[np.ndarray, " parameter"]:
        """Half widths of the 95 % intervals."""
        return t_quantile(self.degrees_of_freedom) * self.errors

    @property
    def gross_weight(self) -> tuple[float, float]:
        """Sum of the axle forces and its standard error (N)."""
        return self.group_weight(range(self.forces.size))

    def group_weight(self, axles) -> tuple[float, float]:
        """Sum of the forces of some axles and its standard error (N)."""
        own = np.array(list(axles), int)
        variance = self.covariance[np.ix_(own, own)].sum()
        return float(self.forces[own].sum()), float(np.sqrt(variance))


class _Weights(NamedTuple):
    """Square roots of inverse covariances: r - U shrink U' r of rows in units of the noise."""

    basis: Float[np.ndarray, "row wave"]
    shrink: Float[np.ndarray, " wave"]
    logarithm: float  # of the determinant of the covariance

    def __call__(self, rows):
        inside = self.basis.T @ rows
        scaled = self.shrink[:, None] * inside if rows.ndim > 1 else self.shrink * inside
        return rows - self.basis @ scaled


def fit_axles(
    lines: InfluenceLines,
    start: AxleGeometry,
    forces: Float[np.ndarray, " axle"],
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
    valid: np.ndarray,
) -> AxleFit:
    """Axles fitted to the readings (SI units) of a crossing, from a geometry and forces (N)."""
    unit_readings = lines.crossing
    noise = white_noise(readings, valid)
    scale = (valid / noise).T.ravel()
    used = scale > 0

    def rows(table):
        """Rows in units of the noise, sensor by sensor, of a table (time, column, sensor)."""
        flat = table.transpose(2, 0, 1).reshape(scale.size, -1)
        return (flat * scale[:, None])[used]

    target = (readings.T.ravel() * scale)[used]
    sensors = readings.shape[1]
    shifts = rows(np.broadcast_to(np.eye(sensors), (times.size, sensors, sensors)))
    geometry, count = start, start.offsets.size
    share = 0.05
    for _ in range(ROUNDS):
        weights, share, level, freedom = _weights(
            geometry, forces, times, lines, rows, shifts, target
        )
        geometry, forces, shift = _weighted(
            weights, geometry, times, unit_readings, rows, shifts, target
        )
    columns = rows(unit_readings(geometry, times))
    slopes = _slopes(unit_readings, geometry, times, rows) @ _per_force(forces, count)
    jacobian = weights(np.hstack([columns, slopes, shifts]))
    sizes = np.linalg.norm(jacobian, axis=0)
    unseen = sizes < 1e-12 * sizes.max()
    sizes = np.where(unseen, 1.0, sizes)
    inverse = np.linalg.pinv(jacobian / sizes)
    covariance = level * (inverse @ inverse.T) / np.outer(sizes, sizes)
    # Readings tell nothing of the place of an axle without a force, nor of one off the bridge.
    most = np.where(np.arange(sizes.size) < count, max(float(forces.sum()), 1e-300), MAX_GAP)
    covariance[unseen, unseen] = most[unseen] ** 2
    own = covariance[: 2 * count + 1, : 2 * count + 1]
    fitted = np.einsum("tas,a->ts", unit_readings(geometry, times), forces) + shift
    left = weights(target - columns @ forces - shifts @ shift)
    deviance = weights.logarithm + left @ left
    return AxleFit(geometry, forces, own, share, freedom, float(deviance), fitted)


def _per_force(forces, count):
    """Slopes by speed, entry time and offsets from those of each axle's readings by its own."""
    matrix = np.zeros((3 * count, count + 1))
    for a in range(count):
        matrix[3 * a, 0] = matrix[3 * a + 1, 1] = forces[a]
        if a:
            matrix[3 * a + 2, 1 + a] = forces[a]
    return matrix


def _slopes(unit_readings, geometry: AxleGeometry, times, rows):
    """Rows of the slopes of each axle's unit readings by speed, entry time and its own offset."""
    crossing = geometry.length / abs(geometry.speed)
    found = []
    for field, step in (
        ("speed", STEPS * abs(geometry.speed)),
        ("entry_time", STEPS * crossing),
        ("offsets", STEPS * geometry.length),
    ):
        ends = [
            unit_readings(
                dataclasses.replace(geometry, **{field: getattr(geometry, field) + sign * step}),
                times,
            )
            for sign in (1, -1)
        ]
        found.append((ends[0] - ends[1]) / (2 * step))
    table = np.stack(found, axis=2)  # time, axle, number, sensor
    return rows(table.reshape(times.size, -1, table.shape[3]))


def _weights(geometry, forces, times, lines, rows, shifts, target):
    """Weights for dynamic wheel forces at a geometry, their share, the level, their freedom."""
    unit_readings = lines.crossing
    columns = unit_readings(geometry, times)
    first = _Weights(np.zeros((target.size, 0)), np.zeros(0), 0.0)
    if lines.covariance is not None:
        first = _inverse_root(rows(_line_errors(lines, geometry, forces, times)), 1.0)
    waves = first(rows(dynamic_readings(lines, geometry, forces, times)))
    slopes = _slopes(unit_readings, geometry, times, rows) @ _per_force(forces, forces.size)
    jacobian = first(np.hstack([rows(columns), slopes, shifts]))
    basis = np.linalg.qr(jacobian / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300))[0]
    outside = waves - basis @ (basis.T @ waves)
    left = first(target)
    left = left - basis @ (basis.T @ left)
    vectors, sizes, _ = np.linalg.svd(outside, full_matrices=False)
    power = sizes**2
    inside = (vectors.T @ left) ** 2
    rest = max(float(left @ left - inside.sum()), 0.0)
    number = target.size - basis.shape[1]

    def squares(log_share):
        return rest + np.sum(inside / (1 + np.exp(2 * log_share) * power))

    def deviance(log_share):
        return np.sum(np.log1p(np.exp(2 * log_share) * power)) + squares(log_share)

    best = scipy.optimize.minimize_scalar(
        deviance, bounds=tuple(np.log(SHARES)), method="bounded", options={"xatol": 1e-3}
    ).x
    share = float(np.exp(best))
    second = _inverse_root(waves, share)
    told = share**2 * power / (1 + share**2 * power)  # of each wave, of which readings tell
    freedom = max(float(told.sum()), 3.0)
    combined = _Chained(first, second)
    return combined, share, max(float(squares(best)) / number, 1.0), freedom


def _line_errors(lines: InfluenceLines, geometry: AxleGeometry, forces, times):
    """Readings (time, number, sensor) of independent errors of the lines, of unit variance."""
    x = geometry.positions(times)
    hats = np.eye(lines.positions.size)
    loads = sum(
        force * np.stack([np.interp(own, lines.positions, hat, 0.0, 0.0) for hat in hats], axis=1)
        for force, own in zip(forces, x.T, strict=True)
    )
    assert lines.covariance is not None
    sensors = len(lines.covariance)
    found = np.zeros((times.size, sensors * hats.shape[0], sensors))
    for s, covariance in enumerate(lines.covariance):
        sizes, vectors = np.linalg.eigh(covariance)
        part = slice(s * hats.shape[0], (s + 1) * hats.shape[0])
        found[:, part, s] = loads @ (vectors * np.sqrt(np.maximum(sizes, 0.0)))
    return found


class _Chained(NamedTuple):
    """One weighting after another."""

    first: _Weights
    second: _Weights

    def __call__(self, rows):
        return self.second(self.first(rows))

    @property
    def logarithm(self) -> float:
        return self.first.logarithm + self.second.logarithm


def _inverse_root(columns, size) -> _Weights:
    """Weights for the covariance 1 + size^2 C C' of columns C."""
    vectors, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    variance = 1 + (size * sizes) ** 2
    return _Weights(vectors, 1 - variance**-0.5, float(np.sum(np.log(variance))))


def _weighted(weights, start: AxleGeometry, times, unit_readings, rows, shifts, target):
    """Geometry, forces and shifts of least weighted squares, forces by variable projection."""
    sign, count = np.sign(start.speed), start.offsets.size
    weighted_shifts, weighted_target = weights(shifts), weights(target)
    sensors = shifts.shape[1]

    def geometry_at(x):
        offsets = np.append(0.0, np.cumsum(np.exp(x[2:])))
        return AxleGeometry(sign * np.exp(x[0]), x[1], offsets, start.length)

    def solution(x):
        columns = np.hstack([weights(rows(unit_readings(geometry_at(x), times))), weighted_shifts])
        sizes = np.linalg.norm(columns, axis=0)
        sizes = np.maximum(sizes, 1e-9 * sizes.max())  # of axles that are not on the bridge
        low = np.concatenate([np.zeros(count), np.full(sensors, -np.inf)])
        found = np.linalg.lstsq(columns / sizes, weighted_target, rcond=None)[0]
        if np.any(found < low):
            found = scipy.optimize.lsq_linear(columns / sizes, weighted_target, (low, np.inf)).x
        return columns, found / sizes

    def residual(x):
        columns, found = solution(x)
        return columns @ found - weighted_target

    gaps = np.clip(np.diff(start.offsets), 1.001 * MIN_GAP, 0.999 * MAX_GAP)
    first = np.concatenate([[np.log(abs(start.speed)), start.entry_time], np.log(gaps)])
    crossing = start.length / abs(start.speed)
    low = [first[0] - 0.3, first[1] - crossing, *np.full(count - 1, np.log(MIN_GAP))]
    high = [first[0] + 0.3, first[1] + crossing, *np.full(count - 1, np.log(MAX_GAP))]
    found = scipy.optimize.least_squares(
        residual, first, bounds=(low, high), diff_step=1e-5, max_nfev=30,
        x_scale=np.array([0.1, 0.1 * crossing, *np.full(count - 1, 0.3)]),
    )  # fmt: skip
    numbers = solution(found.x)[1]
    return geometry_at(found.x), numbers[:count], numbers[count:]
