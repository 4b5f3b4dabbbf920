"""Errors of weighing by the dynamic wheel forces of an unknown road.

Each axle force varies about its static value P_a as a random process of standard deviation d P_a,
with the spectrum S of quarter cars on a rough road, which has peaks at body bounce and axle hop. It
changes the readings by d B w, where the columns of B are readings of P_a sqrt(S df) cos(2 pi f t)
and sin(2 pi f t) on the influence lines, with the vibration of the bridge, and w is white. With
noise of standard deviation s, the readings have the covariance C = s^2 + d^2 B B', and parameters
fitted by least squares with the Jacobian J have

    (J'J)^-1 J' C J (J'J)^-1.

The share d follows from the residuals r = (1 - H) e, H = J (J'J)^-1 J': their power is that of the
noise, and d^2 |(1 - H) B|^2.
"""

import functools
import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.fit.uncertainty.covariance import t_quantile
from tuning.weighing.influence_lines import AxleGeometry, InfluenceLines

BOUNCES, HOPS = (1.3, 1.8, 2.6), (9.0, 11.0, 13.5)  # Hz, of bodies and axles of lorries
UNSPRUNG, DAMPING = 0.1, 0.16  # mass of the axle over that of the body on it; of body and axle
LOWEST, HIGHEST, SPACING = 0.6, 20.1, 0.3  # Hz, of the waves
SHARES = 1e-4, 0.5  # of dynamic wheel forces in the static ones; worst roads have 0.3


@functools.cache
def _total_power() -> float:
    return float(np.sum(_power(np.arange(LOWEST, HIGHEST, SPACING))) * SPACING)


def _power(f: Float[np.ndarray, " wave"]) -> Float[np.ndarray, " wave"]:
    """Spectrum of wheel forces at frequencies (Hz), but for a factor.

    It is that of quarter cars on a road of heights ~ 1 / frequency (ISO 8608), in the mean of usual
    bodies and axles.
    """
    power = np.zeros(f.size)
    for bounce, hop in itertools.product(BOUNCES, HOPS):
        link = bounce**2 + 2j * DAMPING * bounce * f  # stiffnesses over mass of the body
        tyre = UNSPRUNG * hop**2 - bounce**2
        moving = (link - f**2) * (link + tyre - UNSPRUNG * f**2) - link**2
        contact = tyre * (1 - tyre * (link - f**2) / moving)
        power += np.abs(contact / f) ** 2
    return power


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


def dynamic_waves(
    lines: InfluenceLines,
    geometry: AxleGeometry,
    forces: Float[np.ndarray, " axle"],
    times: Float[np.ndarray, " time"],
) -> Float[np.ndarray, "time wave sensor"]:
    """Readings B of the waves of dynamic axle forces, and of the vibration that they excite.

    Waves are counted from the entry of the first axle.
    """
    rate = (times.size - 1) / (times[-1] - times[0])
    frequencies = np.arange(LOWEST, min(HIGHEST, max(0.4 * rate, 2 * LOWEST)), SPACING)
    angle = 2 * np.pi * frequencies * (times[:, None] - geometry.entry_time)
    sizes = np.sqrt(_power(frequencies) * SPACING / _total_power())
    waves = np.concatenate([sizes * np.cos(angle), sizes * np.sin(angle)], axis=1)
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
    squares = outside @ outside.T
    power = float(np.trace(squares))
    noise_power = np.sum(white**2) - np.sum((basis * white[:, None]) ** 2)
    excess = max(float(r @ r - noise_power), 0.0) / max(power, 1e-300)
    of_noise = (basis * white[:, None] ** 2).T @ basis
    middle = of_noise + excess * inside @ inside.T
    inverse = np.linalg.pinv(triangle)
    covariance = inverse @ middle @ inverse.T / np.outer(sizes, sizes)
    freedom = power**2 / max(float(np.sum(squares**2)), 1e-300)
    samples = float(np.sum(weights > 0)) - J.shape[1]
    dominated = excess * power > noise_power
    return DynamicErrors(
        covariance, float(np.sqrt(excess)), max(freedom if dominated else samples, 1.0)
    )


def white_noise(
    readings: Float[np.ndarray, "time sensor"], valid: np.ndarray
) -> Float[np.ndarray, " sensor"]:
    """Standard deviation of white noise by sensor, from second differences of the readings."""
    second = np.abs(np.diff(readings, 2, axis=0))
    counted = valid[2:] & valid[1:-1] & valid[:-2]
    levels = [np.median(second[has, s]) if has.any() else 0.0 for s, has in enumerate(counted.T)]
    return np.maximum(1.4826 * np.array(levels) / np.sqrt(6), 1e-9 * readings.std(axis=0))
