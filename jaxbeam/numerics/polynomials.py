"""Polynomials: Gauss-Legendre quadrature, piecewise Chebyshev series, peaks between samples."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.polynomial import chebyshev, legendre

from jaxbeam.runtime.arrays import (
    Array,
    any_jax,
    array_namespace,
    custom_jvp,
    fori_loop,
    is_jax,
    optimization_barrier,
    slice_in_dim,
    stop_gradient,
    take,
    xp,
)
from jaxbeam.runtime.compiling import compiled_if_traced


def powers(x: Float[Array, " *place"], count: int) -> Float[Array, "power *place"]:
    """Powers 0 to count - 1 of x; differentiable at 0 too, where those of JAX are not."""
    return _powers(x, np.arange(count, dtype=float).reshape(-1, *(1,) * xp.ndim(x)))


@custom_jvp
def _powers(x, exponents):
    return x**exponents


@_powers.defjvp
def _powers_jvp(primals, tangents):
    x, exponents = primals
    found = _powers(x, exponents)
    lower = xp.concatenate([xp.zeros_like(found[:1]), found[:-1]])
    return found, exponents * lower * tangents[0]


@functools.cache
def gauss_nodes(count: int) -> Float[np.ndarray, " node"]:
    """Nodes of the rule, which integrates polynomials of degree 2 count - 1 exactly."""
    return (np.polynomial.legendre.leggauss(count)[0] + 1) / 2


@functools.cache
def gauss_weights(count: int) -> Float[np.ndarray, " node"]:
    """Weights of the rule; their sum is 1."""
    return np.polynomial.legendre.leggauss(count)[1] / 2


@functools.cache
def lagrange_coefficients(count: int) -> Float[np.ndarray, "node power"]:
    """Monomial coefficients of the Lagrange polynomials of the nodes."""
    polynomials, nodes = [], gauss_nodes(count)
    for k, node in enumerate(nodes):
        others = np.delete(nodes, k)
        polynomials.append(np.polynomial.polynomial.polyfromroots(others) / np.prod(node - others))
    return np.array(polynomials)


def lagrange_weights(count: int, fractions) -> Float[np.ndarray, "fraction node"]:
    """Weights that interpolate values at the nodes to fractions of the interval."""
    return np.vander(fractions, count, increasing=True) @ lagrange_coefficients(count).T


@functools.cache
def shift_weights(count: int) -> Float[np.ndarray, "power power"]:
    """Weights 1 / (p - q)!: coefficient p of (1 + s)^p / p! in s^q / q!.

    So are those of phi_q in phi_p of the doubled argument.
    """
    rows = range(count)
    return np.array([[1 / math.factorial(p - q) if q <= p else 0.0 for q in rows] for p in rows])


@functools.cache
def integration_matrix(count: int) -> Float[np.ndarray, "node node"]:
    """Weights a_ij of the values at nodes j in the integral from 0 to node i."""
    nodes, powers = gauss_nodes(count), np.arange(1, count + 1)
    vandermonde = nodes[:, None] ** (powers - 1)
    return np.linalg.solve(vandermonde.T, (nodes[:, None] ** powers / powers).T).T


@compiled_if_traced
def piecewise_chebyshev(nodes, series, x, derivatives) -> Float[Array, "order *position column"]:
    """Derivatives of given orders at positions x, of series (segment, degree, column).

    The derivatives are by x, in the unit of the nodes.
    """
    x = xp.asarray(x, float)
    half_length = xp.diff(nodes) / 2
    segments, terms, modes = series.shape
    derivative_series = [
        xp.asarray(_derivative_matrix(terms, d), series.dtype)
        @ series
        / half_length[:, None, None] ** d
        for d in derivatives
    ]
    series = xp.stack(derivative_series, axis=2).reshape(segments, terms, len(derivatives) * modes)
    segment = xp.sum(x[..., None] >= nodes[1:-1], axis=-1)
    local = (x - take(nodes, segment)) / take(half_length, segment) - 1
    values = _evaluate_series(series, local, segment)
    return xp.moveaxis(values.reshape(*x.shape, len(derivatives), modes), -2, 0)


def slope_jumps(nodes, series) -> Float[Array, "inner column"]:
    """Jumps of the first derivative at the inner nodes, from left to right.

    T_n' is n^2 at 1, and -(-1)^n n^2 at -1.
    """
    n = np.arange(series.shape[1])
    half_length = xp.diff(nodes)[:, None] / 2
    at_left, at_right = (
        xp.einsum("d,sdm->sm", sign * n**2.0, series) / half_length
        for sign in (-((-1.0) ** n), 1.0)
    )
    return at_left[1:] - at_right[:-1]


@custom_jvp
def _evaluate_series(series, local, segment):
    """Values of the series at local positions, -1 to 1, in their segments."""
    if not any_jax(series, local, segment):
        return _concrete_values(series, local, segment)
    return _sum_series(_segment_polynomials(series, local, segment), series)


@_evaluate_series.defjvp
def _evaluate_series_jvp(primals, tangents):
    """A tangent of the position is multiplied by the derivative of the series, not of the table."""
    series, local, segment = primals
    series_tangent, local_tangent, _ = tangents
    table = _segment_polynomials(series, local, segment)
    derivative_series = xp.asarray(_derivative_matrix(series.shape[1], 1), series.dtype) @ series
    values, slopes = xp.split(
        _sum_series(table, xp.concatenate([series, derivative_series], axis=2)), 2, -1
    )
    return values, _sum_series(table, series_tangent) + slopes * local_tangent[..., None]


def _concrete_values(series, local, segment) -> np.ndarray:
    """`_evaluate_series` of concrete numbers, each segment at its own positions only."""
    values = np.empty((*local.shape, series.shape[2]))
    for s in np.unique(segment):
        here = segment == s
        values[here] = chebyshev_polynomials(local[here], series.shape[1]) @ series[s]
    return values


def _sum_series(table, series):
    segments, terms, columns = series.shape
    return table @ series.reshape(segments * terms, columns)


def _segment_polynomials(series, local, segment):
    """Polynomials of all segments, zero except those of the segment of each position."""
    segments, terms, _ = series.shape
    table = chebyshev_polynomials(local, terms)
    masks = (segment[..., None] == s for s in range(segments))
    parts = [xp.where(mask, table, 0.0) for mask in masks] if segments > 1 else [table]
    return xp.concatenate(parts, axis=-1)


@functools.cache
def _derivative_matrix(terms: int, times: int) -> np.ndarray:
    """Matrix that differentiates a Chebyshev series `times` times, keeping its length."""
    matrix = np.zeros((terms, terms))
    matrix[: terms - times] = chebyshev.chebder(np.eye(terms), times)[: terms - times]
    return matrix


@functools.cache
def legendre_to_chebyshev(terms: int) -> np.ndarray:
    """Matrix from Legendre to Chebyshev coefficients, by the values at Chebyshev points."""
    points = chebyshev.chebpts1(terms)
    values = legendre.legvander(points, terms - 1)
    scale = np.where(np.arange(terms) == 0, 1.0, 2.0)[:, None] / terms
    return scale * (chebyshev.chebvander(points, terms - 1).T @ values)


def chebyshev_polynomials(t, terms: int):
    """Chebyshev polynomials of degree 0 to terms - 1 at t, along a new last axis.

    By doubling, T_(k+j) = 2 T_k T_j - T_(k-j): few steps, and accurate.
    """
    axis, lib = t.ndim, array_namespace(t)
    table = lib.stack([lib.ones_like(t), t], axis=axis)
    while table.shape[axis] < terms:
        table = optimization_barrier(table)
        last = 2 * slice_in_dim(table, -1, None, axis)
        lower = lib.flip(slice_in_dim(table, 0, -1, axis), axis)
        higher = last * slice_in_dim(table, 1, None, axis) - lower
        table = lib.concatenate([table, higher], axis=axis)
    return slice_in_dim(table, 0, terms, axis)


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
