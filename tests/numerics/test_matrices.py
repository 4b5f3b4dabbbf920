"""Exponentials of known and of traced matrices beside those of scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

from jaxbeam.numerics.matrices import expm


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
