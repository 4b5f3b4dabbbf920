"""Errors of weighing by the dynamic wheel forces of an unknown road.

Each axle force varies about its static value P_a as a random process of standard deviation d P_a,
with as much power in each octave from body bounce to axle hop. It changes the readings by d B w,
where the columns of B are readings of P_a cos(2 pi f t) and P_a sin(2 pi f t) on the influence
lines, with the vibration of the bridge, and w is white. With noise of standard deviation s, the
readings have the covariance
C = s^2 + d^2 B B', and parameters fitted by least squares with the Jacobian J have

    (J'J)^-1 J' C J (J'J)^-1.

The share d follows from the residuals r = (1 - H) e, H = J (J'J)^-1 J': their power is that of the
noise, and d^2 |(1 - H) B|^2.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.fit.uncertainty.covariance import t_quantile
from tuning.weighing.influence_lines import AxleGeometry, InfluenceLines

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
    lines: InfluenceLines,
    geometry: AxleGeometry,
    forces: Float[np.ndarray, " axle"],
    times: Float[np.ndarray, " time"],
) -> Float[np.ndarray, "time wave sensor"]:
    """Readings B of the waves of dynamic axle forces, and of the vibration that they excite."""
    angle = 2 * np.pi * FREQUENCIES * times[:, None]
    waves = np.concatenate([np.cos(angle), np.sin(angle)], axis=1) / np.sqrt(FREQUENCIES.size)
    table = lines.modulated(geometry, times, waves) * forces[:, None, None]
    return table.reshape(times.size, -1, table.shape[3])


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
