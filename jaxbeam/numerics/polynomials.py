"""Polynomials: Gauss-Legendre quadrature and interpolation, and piecewise Chebyshev series."""

import functools

import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev, legendre

from jaxbeam.runtime.arrays import (
    Array,
    any_jax,
    array_namespace,
    custom_jvp,
    optimization_barrier,
    slice_in_dim,
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
