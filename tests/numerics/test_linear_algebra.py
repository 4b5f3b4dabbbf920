"""Solutions and products of batches of small matrices, against numpy."""

import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.polynomial.chebyshev import chebval
from numpy.testing import assert_allclose

from jaxbeam.numerics import matrices as module
from jaxbeam.numerics.matrices import MAX_UNROLLED_TERMS, expm, matvec, solve_unpivoted
from jaxbeam.numerics.normal_samples import normal_samples
from jaxbeam.numerics.polynomials import piecewise_chebyshev, powers
from tests.differences import central

RANDOM = np.random.default_rng(0)


def systems(size, *batch_shape):
    """Nonsymmetric positive definite matrices, and right sides (batch..., size, 2)."""
    half = RANDOM.normal(size=(*batch_shape, size, size))
    matrix = half @ np.swapaxes(half, -1, -2) + np.eye(size) + 0.3 * half
    return jnp.asarray(matrix), jnp.asarray(RANDOM.normal(size=(*batch_shape, size, 2)))


@pytest.mark.parametrize("size", [1, 2, 7])
def test_solutions_for_any_size_and_batch_shape(size):
    matrix, right = systems(size, 3, 4)
    expected = np.linalg.solve(matrix, right)
    assert_allclose(jax.vmap(jax.vmap(solve_unpivoted))(matrix, right), expected, rtol=1e-9)
    shared = jax.vmap(solve_unpivoted, (None, 0), 2)(matrix[0, 0], right[:, 0])
    assert_allclose(shared[..., 1], np.linalg.solve(matrix[0, 0], right[1, 0]), rtol=1e-9)


@pytest.mark.parametrize("columns", [0, 1, MAX_UNROLLED_TERMS, MAX_UNROLLED_TERMS + 1])
def test_unrolled_and_other_products(columns):
    matrix, vectors = RANDOM.normal(size=(5, columns)), RANDOM.normal(size=(columns, 4))
    found = matvec(jnp.asarray(matrix), jnp.asarray(vectors))
    assert_allclose(found, matrix @ vectors, rtol=1e-13, atol=1e-14)


def test_derivatives_in_forward_and_reverse_mode():
    matrix, right = systems(3, 2)

    def solution(x):
        return jax.vmap(solve_unpivoted)(matrix * x[:, None, None], right + x[:, None, None] ** 2)

    point, weights = np.array([1.1, 0.7]), RANDOM.normal(size=(2, 3, 2))
    expected = central(solution, point, 1e-4)
    assert_allclose(jax.jacfwd(solution)(point), expected, rtol=1e-7, atol=1e-8)
    found = jax.grad(lambda x: (weights * solution(x)).sum())(point)
    assert_allclose(found, np.einsum("ijk,ijkx->x", weights, expected), rtol=1e-7)


# Natural modes of known numbers are solved for once, and are those of the traced ones.


def matrices(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and mass of five unknowns, positive definite."""
    rng = np.random.default_rng(seed)
    parts = rng.normal(size=(2, 5, 5))
    return tuple(part @ part.T + np.eye(5) for part in parts)  # type: ignore[return-value]


def test_known_numbers_are_solved_once(monkeypatch):
    solved, solution = [], module._solution

    def counted(*pair):
        solved.append(pair)
        return solution(*pair)

    monkeypatch.setattr(module, "_solution", counted)
    first, again, other = (module.eigen(*matrices(seed)) for seed in (1, 1, 2))
    assert len(solved) == 2
    assert first[0] is again[0]
    assert not np.allclose(first[0], other[0])


def test_known_and_traced_solutions_agree():
    pair = matrices(3)
    for known, traced in zip(module.eigen(*pair), jax.jit(module.eigen)(*pair), strict=True):
        assert_allclose(np.abs(known), np.abs(traced), atol=1e-12)


# Exponentials of known and of traced matrices beside those of scipy.


@pytest.mark.parametrize("norm", [0.0, 1e-6, 1.0, 5.3, 5.5, 10.7, 10.8, 300.0])
@pytest.mark.parametrize("compile", [lambda function: function, jax.jit])
def test_exponentials_of_any_norm_are_those_of_scipy(norm, compile):
    """Norms just below twice the bound of the approximant too, where JAX scales too little."""
    matrix = np.random.default_rng(1).normal(size=(6, 6))
    matrix = matrix - matrix.T - np.eye(6) / 10
    matrix *= norm / np.linalg.norm(matrix, 1)
    found = compile(expm)(matrix)
    assert isinstance(found, np.ndarray if compile is not jax.jit else jax.Array)
    assert_allclose(found, scipy.linalg.expm(matrix), rtol=0, atol=1e-13 * max(norm, 1))


def test_exponentials_of_matrices_of_any_kind_are_those_of_scipy():
    random = np.random.default_rng(3)
    for size in (1e-9, 0.1, 3.0, 400.0):
        matrix = size * (random.normal(size=(5, 5)) - 3 * np.eye(5))
        expected = scipy.linalg.expm(matrix)
        for found in (expm(matrix), jax.jit(expm)(jnp.asarray(matrix))):
            assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def test_what_is_not_finite_stays_so():
    assert np.isnan(expm(np.full((2, 2), np.nan))).all()


# Piecewise series of known numbers and of traced ones, and their memory.


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


# Standard normal samples in NumPy are those of JAX.


@pytest.mark.parametrize(("seed", "stream"), [(0, 0), (3, 7), (2**31, 1), (2**33 + 5, 2)])
def test_samples_are_those_of_jax(seed, stream):
    key = jax.random.fold_in(jax.random.key(seed), stream)
    expected = np.asarray(jax.random.normal(key, (5000,)))
    assert_allclose(normal_samples(seed, stream, 5000), expected, rtol=0, atol=1e-11)
