"""Drift of a patch, and what its identified inverse leaves."""

import numpy as np
from numpy.testing import assert_allclose

from experiments.studies.creep import CreepFit, fitted_creep
from experiments.studies.patch_drift import CREEP, HYSTERESIS, log_of_patch, what_is_left


def test_what_the_page_says():
    left = what_is_left(fitted_creep(log_of_patch(), "u", "w"))
    assert_allclose(left, [0.096, 0.045, 0.021], atol=5e-4)


def test_the_true_operators_leave_nothing():
    """But the scale: that of the first excursion to 7 V."""
    true = CreepFit(HYSTERESIS, CREEP, 1.0, 0.0, 0.0, 0.0)
    scale = float(HYSTERESIS.first_output(np.asarray(7.0))) / 7.0
    assert_allclose(what_is_left(true).compensated, 1 / scale - 1, atol=1e-9)
