"""Solutions and products of batches of small matrices, against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbeam.numerics.batched_linalg import MAX_UNROLLED_TERMS, matvec, solve_unpivoted
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
