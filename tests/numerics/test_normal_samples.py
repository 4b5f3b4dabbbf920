"""Standard normal samples in NumPy are those of JAX."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbeam.numerics.normal_samples import normal_samples


@pytest.mark.parametrize(("seed", "stream"), [(0, 0), (3, 7), (2**31, 1), (2**33 + 5, 2)])
def test_samples_are_those_of_jax(seed, stream):
    key = jax.random.fold_in(jax.random.key(seed), stream)
    expected = np.asarray(jax.random.normal(key, (5000,)))
    assert_allclose(normal_samples(seed, stream, 5000), expected, rtol=0, atol=1e-11)
