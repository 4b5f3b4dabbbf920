"""Derivatives of affine functions by differences, and functions that are not affine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbeam.analysis.frozen_loop import NotAffineError, affine_jacobian
from jaxbeam.numerics.discretisation import exponential_times, propagate

MATRIX = np.array([[1.0, -3e4], [1e-3, 0.7], [0.0, 2.0]])


def test_jacobian_of_an_affine_function_is_its_matrix():
    found = affine_jacobian(lambda x: MATRIX @ x + 7.0, np.zeros(2))
    np.testing.assert_allclose(found, MATRIX, atol=1e-12)
    assert affine_jacobian(lambda x: np.ones(3), np.zeros(0)).shape == (3, 0)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x**3,
        lambda x: np.clip(x, -1e3, 1e3),
        lambda x: np.where(np.abs(x) < 1e-3, 0.0, x),
        lambda x: jnp.asarray(x),  # computes with JAX
    ],
)
def test_other_functions_are_refused(function):
    with pytest.raises(NotAffineError):
        affine_jacobian(function, np.zeros(2))


def test_traced_functions_are_differentiated_at_their_point():
    found = jax.jit(lambda x: affine_jacobian(lambda y: y**3, x))(np.array([2.0, 3.0]))
    np.testing.assert_allclose(found, np.diag([12.0, 27.0]))


def test_exponentials_of_stacks_are_those_of_scipy():
    import scipy.linalg

    rng = np.random.default_rng(1)
    matrices = rng.standard_normal((3, 4, 4)) * np.array([1e-3, 1.0, 1.0, 0.0])[:, None]
    matrices *= np.array([1e-2, 1.0, 9.0])[:, None, None]
    found = exponential_times(matrices, np.broadcast_to(np.eye(4), (3, 4, 4)))
    for one, matrix in zip(found, matrices, strict=True):
        np.testing.assert_allclose(one, scipy.linalg.expm(matrix), rtol=1e-11, atol=1e-12)


def test_several_times_are_propagated_at_once():
    def matrix(t):
        t = np.asarray(t)
        zero, one = np.zeros_like(t), np.ones_like(t)
        return np.stack([np.stack([zero, one], -1), np.stack([-40 - 9 * t, zero], -1)], -2)

    times = np.array([0.0, 0.3])
    together = propagate(matrix, times, 0.1, 4, np.broadcast_to(np.eye(2), (2, 2, 2)))
    for one, t in zip(together, times, strict=True):
        np.testing.assert_allclose(one, propagate(matrix, t, 0.1, 4, np.eye(2)), rtol=1e-13)
