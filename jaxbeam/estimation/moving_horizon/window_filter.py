"""Filter over a window of samples: most probable states within bounds, from a Kalman filter.

The states x of the present sample and the bounded deflections s of the last ones are jointly
Gaussian, given all readings, by a Kalman filter of x and s. The estimate is the most probable point
within the bounds: with mean m and covariance S of the bounded numbers c, and those of (x, s),

    x* = x + cov(x, c) S^-1 (c* - m),   c* = argmin (c - m)' S^-1 (c - m) within the bounds.

It is that of the optimisation over all states and noises of the window, whose arrival cost is the
Kalman filter before the window (Rao, Rawlings and Mayne, IEEE Trans. Automatic Control 48, 2003).
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.estimator import AbstractSampledFilter
from jaxbeam.estimation.constant_gain import sensor_offsets
from jaxbeam.estimation.crossing_filter import CrossingFilter, corrected
from jaxbeam.numerics.matrices import symmetric_part
from jaxbeam.numerics.optimisation.qp import solve_qp
from jaxbeam.runtime.arrays import Array, cholesky, solve_triangular, xp

RIDGE = 1e-10  # added to correlations, which the deflections of a window make singular


class WindowState(NamedTuple):
    """Mean of states and earlier deflections after a sample, covariance, and the last command."""

    mean: Float[Array, " joint"]
    covariance: Float[Array, "joint joint"]
    command: Float[Array, " actuator"]


class WindowFilter(AbstractSampledFilter):
    """Most probable states of a `filter` within bounds of deflections and weights.

    `rows` give the bounded deflections (m) from the states; they are bounded by `deflection_limit`
    in the last `window` samples, the present one included. `weight_rows` give the weights (N).
    """

    filter: CrossingFilter
    rows: Float[Array, "deflection state"]
    deflection_limit: Float[Array, ""]
    weight_rows: Float[Array, "wheel state"]
    min_weight: Float[Array, ""]
    max_weight: Float[Array, ""]
    window: int = eqx.field(static=True)

    @property
    def earlier(self) -> int:
        """Number of deflections of earlier samples."""
        return (self.window - 1) * self.rows.shape[0]

    def initial_state(self):
        start = self.filter.initial_state()
        grown = ((0, self.earlier), (0, self.earlier))
        return WindowState(
            xp.pad(start.x, (0, self.earlier)), xp.pad(start.covariance, grown), start.command
        )

    def tabulated(self, times):
        return dataclasses.replace(self, filter=self.filter.tabulated(times))

    def update(self, state, measurement, t):
        command = measurement.command
        transition, C, D = self.filter.model_at(t)
        states, earlier = self.rows.shape[1], self.earlier
        # Deflections of the last sample become the first of the earlier ones.
        shift = self._deflections()[:earlier]
        matrix = xp.concatenate([xp.pad(transition.matrix, ((0, 0), (0, earlier))), shift])
        x = transition.predict(state.mean[:states], state.command, command)
        mean = xp.concatenate([x, shift @ state.mean])
        noise = xp.pad(transition.noise_covariance, (0, earlier))
        covariance = symmetric_part(matrix @ state.covariance @ matrix.T + noise)
        readings = C @ x + D @ command + sensor_offsets(self.filter.filtered.plant)
        C = xp.pad(C, ((0, 0), (0, earlier)))
        gain, covariance = corrected(covariance, C, self.filter.sensor_chain.noise_covariance)
        mean = mean + gain @ (measurement.readings - readings)
        within = self._within_bounds(mean, covariance)
        return self.filter.estimate(within[:states], t), WindowState(mean, covariance, command)

    def _deflections(self) -> Float[Array, "deflection joint"]:
        """Rows of the present and of the earlier deflections."""
        states, earlier = self.rows.shape[1], self.earlier
        present = xp.pad(self.rows, ((0, 0), (0, earlier)))
        return xp.concatenate([present, xp.eye(earlier, states + earlier, k=states)])

    def _within_bounds(self, mean, covariance):
        """Most probable point within the bounds; the mean where there is none."""
        deflections = self._deflections()
        weights = xp.pad(self.weight_rows, ((0, 0), (0, self.earlier)))
        rows = xp.concatenate([deflections, weights])
        counts = deflections.shape[0], weights.shape[0]
        if not sum(counts):
            return mean
        limits = xp.full(counts[0], self.deflection_limit)
        highest = xp.concatenate([limits, xp.full(counts[1], self.max_weight)])
        lowest = xp.concatenate([-limits, xp.full(counts[1], self.min_weight)])
        numbers, common = rows @ mean, rows @ covariance
        variance = xp.diagonal(common @ rows.T)
        certain = variance <= 0
        size = xp.sqrt(xp.where(certain, 1.0, variance))
        correlation = (common @ rows.T) / (size * size[:, None]) + RIDGE * np.eye(sum(counts))
        correlation = xp.where(certain[:, None] | certain, np.eye(sum(counts)), correlation)
        root = cholesky(correlation)
        M = xp.concatenate([root, -root])
        sides = xp.concatenate([highest - numbers, numbers - lowest]) / xp.concatenate([size, size])
        # A number that is known, as before the first readings, is no matter of bounds.
        free = xp.concatenate([certain, certain]) | ~xp.isfinite(sides)
        M, sides = xp.where(free[:, None], 0.0, M), xp.where(free, 1.0, sides)
        found = solve_qp(np.eye(sum(counts)), xp.zeros(sum(counts)), M, sides)
        change = solve_triangular(root, found.x, lower=True, transposed=True) / size
        change = xp.where(certain | ~found.solved, 0.0, change)
        return mean + common.T @ change
