"""Contact forces at instants: fewer or more loads than modes, beside dense systems of each run."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbeam.model.contact import _pressing_forces


@pytest.mark.parametrize(("loads", "modes"), [(1, 3), (3, 3), (7, 3), (40, 5)])
@pytest.mark.parametrize("compile", [lambda function: function, jax.jit])
def test_pressing_forces_obey_the_contact_law(loads, modes, compile):
    """Of masses from nothing to a hundred times the modal mass; none off the beam."""
    random = np.random.default_rng(loads)
    shape = random.normal(size=(4, loads, modes))
    mass = 10.0 ** random.uniform(-3, 2, size=(4, loads, 2))
    mass[:, ::3] = 0.0
    free = random.normal(size=(4, loads, 2))
    found = compile(_pressing_forces)(shape, mass, free)
    for instant in range(4):
        for run in range(2):
            coupling = mass[instant, :, run, None] * (shape[instant] @ shape[instant].T)
            expected = np.linalg.solve(np.eye(loads) + coupling, free[instant, :, run])
            assert_allclose(found[instant, :, run], expected, rtol=1e-9, atol=1e-11)
