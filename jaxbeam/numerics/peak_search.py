"""Peak of the polynomial through a few samples: its largest absolute value, or other magnitude."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.numerics.polynomials import powers
from jaxbeam.runtime.arrays import (
    Array,
    fori_loop,
    is_jax,
    optimization_barrier,
    stop_gradient,
    take,
    xp,
)

ESTIMATE_ITERATIONS = 2  # of Newton's method in an estimate
TIE_ROUNDING_UNITS = 8  # by which equal numbers may differ
SHORT_STEP = 1e-6  # of the longest step, within which nothing is higher than at its ends
START_POINTS = 17  # of the search, closer to each other than extrema of the curve can be
NEWTON_ITERATIONS = 6  # from each start point


class Curve(NamedTuple):
    """Polynomial in 2 c - 1 and its first two derivatives: coefficients, lowest power first."""

    value: Array
    slope: Array
    curvature: Array


@functools.cache
def interpolation_matrix(points: tuple[float, ...]) -> np.ndarray:
    """Matrix from samples at points in [0, 1] to the coefficients of a `Curve`, concatenated."""
    value = np.linalg.inv(_to_unit_interval(points)[:, None] ** np.arange(len(points)))
    slope = np.polynomial.polynomial.polyder(value)
    return np.concatenate([value, slope, np.polynomial.polynomial.polyder(slope)])


def newton_step_limit(points: tuple[float, ...]) -> float:
    """Step limit of Newton's method in `estimate_peak`: a few steps cross half of any gap."""
    return float(np.diff(_to_unit_interval(points)).max()) / 3


def _to_unit_interval(points: tuple[float, ...]) -> np.ndarray:
    return 2 * np.array(points) - 1


def _interpolate(samples: Float[Array, "point *rest"], points: tuple[float, ...]) -> Curve:
    count = len(points)
    rows = xp.tensordot(interpolation_matrix(points), samples, axes=1)
    return Curve(rows[:count], rows[count : 2 * count - 1], rows[2 * count - 1 :])


def polynomial(coefficients, position):
    """Value of a polynomial; coefficients with the lowest power first.

    A list of coefficients is evaluated by Horner's rule, unrolled, for programs that do so often;
    an array by powers of the position, which compile faster.
    """
    if not isinstance(coefficients, list):
        count, *rest = coefficients.shape
        more = (1,) * (xp.ndim(position) - len(rest))
        return xp.sum(coefficients.reshape(count, *more, *rest) * powers(position, count), axis=0)
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = coefficient + position * value
    return value


def _newton_stationary_point(curve: Curve, start, step_limit: float, iterations: int):
    """Stationary point near the start, by Newton's method with limited steps."""

    def newton_step(_, position):
        second_derivative = polynomial(curve.curvature, position)
        singular = second_derivative == 0
        step = xp.where(
            singular,
            0.0,
            polynomial(curve.slope, position) / xp.where(singular, 1.0, second_derivative),
        )
        return xp.clip(position - xp.clip(step, -step_limit, step_limit), -1.0, 1.0)

    return fori_loop(0, iterations, newton_step, start)


def max_with_ties(
    values: Float[Array, "candidate *rest"],
) -> tuple[Float[Array, " *rest"], Bool[Array, "candidate *rest"]]:
    """Largest of the candidates, and which of them equal it: quicker than `argmax`.

    They may differ by rounding, as XLA may compute a candidate once for the maximum and once more,
    rounded otherwise, for the comparison.
    """
    maximum = xp.max(values, axis=0)
    tolerance = TIE_ROUNDING_UNITS * xp.finfo(values.dtype).eps
    return maximum, values >= maximum - tolerance * xp.abs(maximum)


def estimate_peak(
    samples: Float[Array, "point *rest"],
    points: tuple[float, ...],
    magnitude: Callable = xp.abs,
) -> Float[Array, " *rest"]:
    """Estimate of the peak, searched from the largest sample only.

    It selects the step with the peak among many; `refine_peak` then computes the peak there.
    """
    magnitudes = magnitude(samples)
    largest = xp.max(magnitudes, axis=0)
    start = take(_to_unit_interval(points), xp.argmax(magnitudes, axis=0)).astype(samples.dtype)
    curve = Curve(*map(list, _interpolate(samples, points)))  # as programs search often
    position = _newton_stationary_point(
        curve, start, newton_step_limit(points), iterations=ESTIMATE_ITERATIONS
    )
    return xp.maximum(magnitude(polynomial(curve.value, position)), largest)


def steps_near_peak(
    samples: Float[Array, "step point *rest"],
    lengths: Float[Array, " step"],
    points: tuple[float, ...],
    magnitude: Callable,
) -> Int[Array, "candidate *rest"]:
    """Indices of three steps, one of which has the peak of the polynomials through the samples.

    They are the step with the largest of equidistant values, and the nearest steps before and after
    it whose `lengths` are not (nearly) zero, as are those between events at one time.
    """
    grid = np.linspace(-1.0, 1.0, START_POINTS)[:, None] ** np.arange(len(points))
    weights = grid @ interpolation_matrix(points)[: len(points)]
    largest = xp.max(magnitude(xp.einsum("gp,tp...->tg...", weights, samples)), axis=1)
    highest, last = xp.argmax(largest, axis=0), samples.shape[0] - 1
    column = -1, *(1,) * (samples.ndim - 2)
    index = np.arange(last + 1).reshape(column)
    long = (lengths > SHORT_STEP * xp.max(lengths)).reshape(column)
    before = xp.max(xp.where(long & (index < highest), index, 0), axis=0)
    after = xp.min(xp.where(long & (index > highest), index, last), axis=0)
    return xp.stack([before, highest, after])


@jax.named_scope("peaks")
def locate_peak(
    samples: Float[Array, "point *rest"], points: tuple[float, ...], magnitude: Callable = xp.abs
) -> tuple[Float[Array, " *rest"], Float[Array, " *rest"]]:
    """Position in [-1, 1] and value of the largest magnitude of the polynomial of samples."""
    curve = _interpolate(samples, points)
    if not is_jax(samples):  # NumPy takes long for powers
        curve = Curve(*map(list, curve))
    # The start points are candidates too: Newton's method may leave an end for a lower extremum.
    starts = np.linspace(-1.0, 1.0, START_POINTS).reshape(-1, *(1,) * (samples.ndim - 1))
    starts = xp.broadcast_to(starts.astype(samples.dtype), (START_POINTS, *samples.shape[1:]))
    found = _newton_stationary_point(curve, starts, 2 / START_POINTS, NEWTON_ITERATIONS)
    positions = xp.concatenate([starts, found])
    largest, ties = max_with_ties(magnitude(polynomial(curve.value, positions)))
    return xp.max(xp.where(ties, positions, -1.0), axis=0), largest


def refine_peak(
    samples: Float[Array, "point *rest"],
    points: tuple[float, ...],
    magnitude: Callable = xp.abs,
    position: Float[Array, " *rest"] | None = None,
) -> tuple[Float[Array, " *rest"], ...]:
    """Largest magnitude of the polynomial through the samples, and its position in [0, 1].

    It is that of `locate_peak` unless a `position` is given.

    `points` are the positions in [0, 1] of the samples, ascending and with both ends. Inside the
    curve the position has the derivative of a stationary point, so that second derivatives of the
    magnitude are those of the moving peak; at an end it is fixed.
    """
    if position is None:
        position, _ = locate_peak(stop_gradient(samples), points, magnitude)
    position = optimization_barrier(stop_gradient(position))
    curve = _interpolate(samples, points)
    if is_jax(samples):
        slope = polynomial(curve.slope, position)
        curvature = stop_gradient(polynomial(curve.curvature, position))
        moves = (xp.abs(position) < 1) & (curvature != 0)
        change = (slope - stop_gradient(slope)) / xp.where(moves, curvature, 1.0)
        position = position - xp.where(moves, change, 0.0)
    return magnitude(polynomial(curve.value, position)), (position + 1) / 2
