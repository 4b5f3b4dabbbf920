"""The Levenberg-Marquardt method against scipy, and derivatives of known numbers."""

import dataclasses

import numpy as np
import pytest
import scipy.optimize

from tuning.fit.least_squares import LOSSES, levenberg_marquardt, robust_residual, robust_slope
from tuning.parameters.free import FreeParameter
from tuning.parameters.prior import Prior

TIMES = np.linspace(0.0, 2.0, 40)
READINGS = 3.0 * np.exp(-0.7 * TIMES) + 0.2 * np.cos(9 * TIMES)


def decay(point):
    """Residuals of a decay and their derivatives; not finite for a growing one."""
    size, rate = point
    if rate < 0:
        return np.full(40, np.nan), np.full((40, 2), np.nan)
    shape = np.exp(-rate * TIMES)
    return size * shape - READINGS, np.stack([shape, -size * TIMES * shape], axis=1)


def test_minimum_is_that_of_scipy():
    found = levenberg_marquardt(decay, np.array([0.5, 4.0]), 1e-10, 1e-10, 60)
    expected = scipy.optimize.least_squares(
        lambda x: decay(x)[0], [2.0, 1.0], lambda x: decay(x)[1], xtol=1e-14, ftol=1e-14
    )
    assert found.converged
    # The search ends where rounding hides a decrease: far within a standard error.
    variance = 2 * expected.cost / (TIMES.size - 2)
    errors = np.sqrt(variance * np.diag(np.linalg.inv(expected.jac.T @ expected.jac)))
    assert np.all(np.abs(found.point - expected.x) < 1e-5 * errors)


def test_points_without_residuals_are_rejected():
    """From a start so far that full steps lead to growing decays."""
    visited = []

    def watched(point):
        visited.append(point[1])
        return decay(point)

    found = levenberg_marquardt(watched, np.array([30.0, 0.02]), 1e-10, 1e-10, 60)
    assert found.converged and found.point[1] == pytest.approx(0.7, abs=0.1)
    without = levenberg_marquardt(decay, np.array([1.0, -1.0]), 1e-10, 1e-10, 60)
    assert not without.converged and without.point[1] == -1.0


def test_too_few_steps_do_not_converge():
    assert not levenberg_marquardt(decay, np.array([0.5, 4.0]), 1e-10, 1e-10, 3).converged


def slope_by_difference(function, x, h=1e-6):
    return (function(x + h) - function(x - h)) / (2 * h)


@pytest.mark.parametrize("loss", LOSSES)
def test_slopes_of_losses(loss):
    residuals = np.array([-40.0, -1.5, -1.2, -1e-3, 0.0, 0.3, 1.4, 7.0])
    expected = slope_by_difference(lambda r: np.asarray(robust_residual(loss, r)), residuals)
    np.testing.assert_allclose(robust_slope(loss, residuals), expected, rtol=1e-7)


@pytest.mark.parametrize("scale", ["linear", "log", "logit"])
@pytest.mark.parametrize(("low", "high"), [(1.0, 5.0), (1.0, np.inf), (-np.inf, 5.0), (None, None)])
def test_slopes_of_bounds_and_priors(scale, low, high):
    bounded = low is not None and np.isfinite(high - low)
    prior = Prior(1.0, 5.0, 2.0, 0.3, scale) if bounded else Prior(mean=2.0, deviation=0.3)
    low, high = (-np.inf, np.inf) if low is None else (low, high)
    parameter = FreeParameter("a", "1", 2.0, low, high, 1.0, prior)
    y = 0.37

    def value(y):
        return float(parameter.from_unbounded(np.float64(y)))

    assert parameter.slope(y) == pytest.approx(slope_by_difference(value, y), rel=1e-8)
    expected = slope_by_difference(lambda v: float(prior.prior_residual(np.float64(v))), 2.5)
    assert prior.residual_slope(2.5) == pytest.approx(expected, rel=1e-8)
    none = dataclasses.replace(prior, mean=None, deviation=None)
    assert none.residual_slope(2.5) == 0.0
