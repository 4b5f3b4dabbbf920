"""Piecewise series of known numbers and of traced ones, and their memory."""

import tracemalloc

import jax
import numpy as np
from numpy.polynomial.chebyshev import chebval
from numpy.testing import assert_allclose

from jaxbeam.numerics.polynomials import piecewise_chebyshev, powers

RANDOM = np.random.default_rng(0)


def test_values_are_those_of_the_series_of_each_segment():
    nodes, series = np.array([0.0, 1.0, 1.5, 4.0]), RANDOM.normal(size=(3, 6, 2))
    x = RANDOM.uniform(0.0, 4.0, size=(5, 4))
    known = piecewise_chebyshev(nodes, series, x, (0, 1))
    traced = jax.jit(lambda x: piecewise_chebyshev(nodes, series, x, (0, 1)))(x)
    assert_allclose(known, traced, rtol=1e-12, atol=1e-12)
    segment = np.searchsorted(nodes[1:-1], x, side="right")
    local = 2 * (x - nodes[segment]) / np.diff(nodes)[segment] - 1
    for index in np.ndindex(x.shape):
        expected = chebval(local[index], series[segment[index]])
        assert_allclose(known[0][index], expected, rtol=1e-12, atol=1e-12)


def test_memory_does_not_grow_with_the_number_of_segments():
    """It had been proportional to it."""

    def peak(segments):
        nodes, series = np.linspace(0.0, 1.0, segments + 1), np.ones((segments, 12, 8))
        x = np.linspace(0.0, 1.0, 4000)
        tracemalloc.start()
        piecewise_chebyshev(nodes, series, x, (0, 1))
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    assert peak(40) < 2 * peak(2)


def test_derivatives_of_powers_at_zero():
    """Of 2 + 3 x + 5 x^2 + 7 x^3."""
    coefficients = np.array([2.0, 3.0, 5.0, 7.0])

    def value(x):
        return coefficients @ powers(x, 4)

    zero = np.zeros(())
    assert (value(zero), jax.grad(value)(zero), jax.hessian(value)(zero)) == (2.0, 3.0, 10.0)
