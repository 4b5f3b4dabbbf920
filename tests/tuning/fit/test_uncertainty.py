"""Uncertainty of a fit, against normal equations and residuals of known autocorrelation."""

import numpy as np
import pytest

from tuning.fit.uncertainty.covariance import (
    REPORTED_CHANGE,
    UNBOUNDED_SD,
    autocorrelation_factor,
    uncertainty,
)

NAMES = ["a", "b", "c"]


def jacobian(*spreads, seed=0):
    """Random Jacobian (100, parameter) with these standard errors of each parameter alone."""
    columns = np.random.default_rng(seed).normal(size=(100, len(spreads)))
    return columns / np.linalg.norm(columns, axis=0) / spreads


def test_covariance_is_that_of_the_normal_equations():
    rows, sizes = jacobian(0.01, 2.0, 1e-6), np.array([1.0, 100.0, 1e-4])
    found = uncertainty(NAMES, rows, sizes)
    covariance = np.linalg.inv(rows.T @ rows)
    errors = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.errors, errors, rtol=1e-9)
    np.testing.assert_allclose(found.correlation, covariance / np.outer(errors, errors), rtol=1e-9)
    assert found.unidentifiable == []


def test_a_parameter_without_effect_is_unidentifiable():
    rows = jacobian(0.01, 1.0, 0.02)
    rows[:, 1] = 0.0
    found = uncertainty(NAMES, rows, np.array([1.0, 3.0, 1.0]))
    assert found.errors[1] == np.inf
    assert found.unidentifiable == [{"b": pytest.approx(3.0 * REPORTED_CHANGE)}]
    assert np.isnan(found.correlation[1]).all() and np.isnan(found.correlation[:, 1]).all()
    others = np.linalg.inv(rows[:, ::2].T @ rows[:, ::2])
    np.testing.assert_allclose(found.errors[::2], np.sqrt(np.diag(others)), rtol=1e-9)


def test_collinear_parameters_are_unidentifiable_together():
    rows = jacobian(0.01, 0.01, 0.02)
    rows[:, 1] = -2.0 * rows[:, 0]
    found = uncertainty(NAMES, rows, np.ones(3))
    assert found.errors[0] == found.errors[1] == np.inf
    assert found.errors[2] == pytest.approx(0.02, rel=0.1)
    (direction,) = found.unidentifiable
    assert set(direction) == {"a", "b"}
    assert direction["a"] == pytest.approx(REPORTED_CHANGE)
    assert direction["b"] == pytest.approx(REPORTED_CHANGE / 2)


def test_unidentifiable_directions_widen_the_errors_of_small_components():
    """An error of 3 sizes along (1, 0.05) is an error of 0.15 in the second parameter."""
    along, across = np.array([1.0, 0.05]), np.array([-0.05, 1.0])
    length = np.linalg.norm(along)
    rows = np.stack([along / length / 3.0, across / length / 1e-3])
    found = uncertainty(NAMES[:2], rows, np.ones(2))
    assert found.errors[0] == np.inf
    assert found.errors[1] == pytest.approx(3.0 * 0.05 / length, rel=1e-3)
    assert [set(direction) for direction in found.unidentifiable] == [{"a"}]


def test_fewer_residuals_than_parameters():
    found = uncertainty(NAMES, np.array([[100.0, 0.0, 0.0]]), np.ones(3))
    assert found.errors.tolist() == [pytest.approx(0.01), np.inf, np.inf]
    assert UNBOUNDED_SD > 1 and len(found.unidentifiable) == 2


def test_autocorrelation_factor_of_white_and_constant_residuals():
    white = np.random.default_rng(0).normal(size=(200, 300))
    factors = [autocorrelation_factor(series) for series in white]
    assert np.mean(factors) == pytest.approx(1.0, abs=0.05)
    assert min(factors) == 1.0
    assert autocorrelation_factor(np.full(50, 3.0)) == 1.0


@pytest.mark.parametrize("r", [0.3, 0.7, 0.9])
def test_autocorrelation_factor_of_a_first_order_process(r):
    """Its correlations are powers of r: 1 + 2 (r + r^2 + ...) = (1 + r) / (1 - r)."""
    white = np.random.default_rng(1).normal(size=(50, 4000))
    series = np.zeros_like(white)
    for i in range(1, white.shape[1]):
        series[:, i] = r * series[:, i - 1] + white[:, i]
    factors = [autocorrelation_factor(part) for part in series]
    assert np.mean(factors) == pytest.approx((1 + r) / (1 - r), rel=0.1)
