"""Small linear systems, many at a time, against numpy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbeam.numerics.batched_linalg import MAX_UNROLLED_TERMS, matvec, solve_unpivoted
from tests.differences import central

RANDOM = np.random.default_rng(0)


def systems(size, *lanes):
    """Positive matrices, made uneven, and right sides."""
    half = RANDOM.normal(size=(*lanes, size, size))
    matrix = half @ np.swapaxes(half, -1, -2) + np.eye(size) + 0.3 * half
    return jnp.asarray(matrix), jnp.asarray(RANDOM.normal(size=(*lanes, size, 2)))


@pytest.mark.parametrize("size", [1, 2, 7])
def test_systems_of_any_size_and_in_any_number(size):
    matrix, right = systems(size, 3, 4)
    expected = np.linalg.solve(matrix, right)
    assert_allclose(jax.vmap(jax.vmap(solve_unpivoted))(matrix, right), expected, rtol=1e-9)
    shared = jax.vmap(solve_unpivoted, (None, 0), 2)(matrix[0, 0], right[:, 0])
    assert_allclose(shared[..., 1], np.linalg.solve(matrix[0, 0], right[1, 0]), rtol=1e-9)


@pytest.mark.parametrize("columns", [0, 1, MAX_UNROLLED_TERMS, MAX_UNROLLED_TERMS + 1])
def test_products_spelt_out_or_not(columns):
    matrix, lanes = RANDOM.normal(size=(5, columns)), RANDOM.normal(size=(columns, 4))
    found = matvec(jnp.asarray(matrix), jnp.asarray(lanes))
    assert_allclose(found, matrix @ lanes, rtol=1e-13, atol=1e-14)


def test_slopes_forward_and_in_reverse():
    matrix, right = systems(3, 2)

    def one(x):
        return jax.vmap(solve_unpivoted)(matrix * x[:, None, None], right + x[:, None, None] ** 2)

    at, weights = np.array([1.1, 0.7]), RANDOM.normal(size=(2, 3, 2))
    expected = central(one, at, 1e-4)
    assert_allclose(jax.jacfwd(one)(at), expected, rtol=1e-7, atol=1e-8)
    found = jax.grad(lambda x: (weights * one(x)).sum())(at)
    assert_allclose(found, np.einsum("ijk,ijkx->x", weights, expected), rtol=1e-7)
