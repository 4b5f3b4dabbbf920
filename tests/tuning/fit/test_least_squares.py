"""Priors, scales, robust losses, multi-start and stages, on readings that are a formula."""

import dataclasses
import sys

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from tests.tuning.small_rig import (
    AMPLITUDES,
    CASE,
    NOISE,
    TRUTH,
    clean,
    dataset,
    fit,
    formula,
    least_squares,
)
from tuning.checkpoint import Checkpoint
from tuning.fit.identify import _stage_mask, identify
from tuning.fit.least_squares import (
    HUBER_THRESHOLD,
    LOSSES,
    check_loss,
    draw_start_points,
    levenberg_marquardt,
    multi_start,
    robust_residual,
    robust_slope,
    variance_factor,
)
from tuning.parameters import FreeParameter, Prior, free_parameters

ADDRESSES = list(TRUTH)
VALUES = np.array(list(TRUTH.values()))


@pytest.fixture(scope="module")
def plain():
    return fit()


def test_optimum_equals_that_of_scipy():
    """Least squares with derivatives by differences, from the same start."""
    plain = fit(least_squares(logs=1))

    def residuals(values):
        residuals = plain.dataset.measured[0, :, 0] - formula(*values, AMPLITUDES[0])
        return np.asarray(residuals) / plain.noise[0, 0]

    solution = scipy.optimize.least_squares(residuals, plain.start_values, x_scale=[20, 0.03, 0.2],
                                         xtol=1e-12, ftol=1e-14, gtol=1e-12)  # fmt: skip
    np.testing.assert_allclose(plain.values, solution.x, rtol=1e-6)
    # Noise without bias: by the number of samples less that of parameters.
    freedom = solution.fun.size - solution.x.size
    np.testing.assert_allclose(np.sum(solution.fun**2) / freedom, 1.0, rtol=1e-5)
    errors = np.sqrt(np.diag(np.linalg.inv(solution.jac.T @ solution.jac)))
    np.testing.assert_allclose(
        plain.errors, errors, rtol=0.15
    )  # some residuals look autocorrelated


# Losses of scipy, as functions of the squared residual.
RHO = {
    "squares": lambda z: z,
    "soft-l1": lambda z: 2 * (np.sqrt(1 + z) - 1),
    "huber": lambda z: np.where(
        z <= HUBER_THRESHOLD**2, z, 2 * HUBER_THRESHOLD * np.sqrt(z) - HUBER_THRESHOLD**2
    ),
}


@pytest.mark.parametrize("loss", RHO)
def test_losses(loss):
    residuals = np.linspace(-9, 9, 101)
    losses = np.asarray(robust_residual(loss, jnp.asarray(residuals))) ** 2
    np.testing.assert_allclose(losses, RHO[loss](residuals**2), rtol=1e-12, atol=1e-14)
    normal = np.random.default_rng(0).normal(size=100_000)
    # The threshold of Huber's loss is chosen for an efficiency of 95 %.
    expected = {"squares": 1.0, "huber": 1 / 0.95, "soft-l1": None}[loss]
    assert expected is None or variance_factor(loss, normal) == pytest.approx(expected, rel=0.01)


def test_unknown_losses_are_refused():
    with pytest.raises(ValueError, match="one of squares, soft-l1, huber, not 'cauchy'"):
        check_loss("cauchy")


@pytest.mark.parametrize("loss", ["soft-l1", "huber"])
def test_outliers_hardly_move_a_robust_fit(loss):
    rng = np.random.default_rng(3)
    measured = clean() + NOISE * rng.normal(size=clean().shape)
    outliers = rng.random(measured.shape) < 0.08
    measured[outliers] += 0.7
    ordinary, robust = (
        fit(least_squares(loss=name, measured=measured)) for name in ("squares", loss)
    )
    offset = ADDRESSES.index("sensors.0.offset")
    assert abs(ordinary.values[offset] - 0.2) > 0.04
    assert np.all(np.abs(robust.values - VALUES) < 4 * robust.errors)
    assert robust.errors[offset] < ordinary.errors[offset] / 3
    assert np.all(robust.noise < 2 * NOISE) and np.all(ordinary.noise > 5 * NOISE)


def test_masked_samples_do_not_count():
    measured, mask = clean() + 0.0, np.ones(clean().shape)
    measured[0, 30:40], mask[0, 30:40] = 50.0, 0.0
    masked = fit(least_squares(measured=measured, mask=mask))
    np.testing.assert_allclose(masked.values, VALUES, rtol=1e-6)
    assert np.isnan(masked.residuals[0, 30:40]).all()


def test_a_prior_counts_as_a_measurement(plain):
    """With a prior as narrow as the likelihood, the value lies midway, the error is smaller."""
    damping = ADDRESSES.index("beam.damping_ratio")
    error, value = plain.errors[damping], plain.values[damping]
    prior = Prior(mean=float(value + 2 * error), deviation=float(error))
    with_prior = fit(least_squares(free=dict.fromkeys(TRUTH) | {"beam.damping_ratio": prior}))
    assert with_prior.values[damping] == pytest.approx(value + error, abs=0.1 * error)
    assert with_prior.errors[damping] == pytest.approx(error / np.sqrt(2), rel=0.05)


def test_residual_of_a_prior():
    priors = {"beam.mass_per_length": Prior(mean=2.0, deviation=0.1)}
    parameter = free_parameters([CASE], priors, 1.0)[0]
    assert parameter.low == 0.0
    assert parameter.prior.prior_residual(jnp.asarray(2.2)) == pytest.approx(2.0)


@pytest.mark.parametrize("scale", ["log", "logit"])
def test_scales(scale):
    prior = Prior(0.01, 100.0, scale=scale)
    parameter = FreeParameter("x", "m", 0.1, 0.01, 100.0, 99.99, prior)

    def value_at(unbounded):
        return float(parameter.from_unbounded(jnp.asarray(unbounded)))

    for value in (0.15, 1.0, 3.0, 99.0):
        assert value_at(parameter.to_unbounded(value)) == pytest.approx(value)
    shares = parameter.unbounded_at_fraction(np.array([0.25, 0.5, 0.75]))
    expected = [0.1, 1.0, 10.0] if scale == "log" else [25.0075, 50.005, 75.0025]
    np.testing.assert_allclose([value_at(y) for y in shares], expected, rtol=1e-9)


@pytest.mark.parametrize(
    "given, words",
    [
        ({"scale": "cube"}, "a scale is one of linear, log, logit, not 'cube'"),
        ({"mean": 1.0}, "a prior needs both a mean and a deviation"),
        ({"mean": 1.0, "deviation": 0.0}, "the deviation of a prior must be positive, not 0"),
        ({"scale": "log"}, "the scale 'log' needs two bounds, low and high"),
        ({"low": -1.0, "high": 1.0, "scale": "log"}, "on a log scale bounds and mean must be"),
    ],
)
def test_faulty_priors(given, words):
    with pytest.raises(ValueError, match=words):
        Prior(**given)


def test_parameters_of_every_log():
    parameters = free_parameters([CASE, CASE], {"logs.*.loads.0.speed": (0.5, 2.0)}, 1.0)
    assert [parameter.address for parameter in parameters] == [
        f"logs.{i}.loads.0.speed" for i in (0, 1)
    ]
    with pytest.raises(ValueError, match=r"logs.0.loads.0.speed is free twice; name it once"):
        twice = {"logs.*.loads.0.speed": None, "logs.0.loads.0.speed": None}
        free_parameters([CASE, CASE], twice, 1.0)


def test_stages_move_only_their_parameters(plain):
    mask = _stage_mask(plain.parameters, ["beam.damping_ratio", "sensors.0.offset"])
    assert mask.tolist() == [False, True, True]
    solution = plain.least_squares.solve(plain.dataset.measured, free=mask)
    assert solution.values[0] == pytest.approx(19.0) and solution.values[2] != pytest.approx(0.0)
    assert solution.uncertainty.errors[0] == 0.0 < solution.uncertainty.errors[1]
    with pytest.raises(ValueError, match="a stage fits beam.length, which is not free; free are"):
        _stage_mask(plain.parameters, ["beam.length"])


BOUNDS = {
    "beam.flexural_rigidity": (4.0, 60.0),
    "beam.damping_ratio": Prior(0.001, 0.2, scale="log"),
    "sensors.0.offset": None,
}


@pytest.fixture(scope="module")
def wide():
    return least_squares(free=BOUNDS)


def test_many_starts_find_several_minima(wide):
    """The misfit of two oscillations of different frequencies has several minima."""
    minima = multi_start(wide, wide.data.measured, 12, seed=1)
    assert len(minima) > 1 and sum(minimum.starts for minimum in minima) == 12
    costs = [minimum.cost for minimum in minima]
    assert costs == sorted(costs) and costs[1] > 2 * costs[0]
    np.testing.assert_allclose(minima[0].values, VALUES, rtol=0.1)


def test_starts_fill_the_bounds(wide):
    points = draw_start_points(wide.parameters, 9, seed=0)
    values = np.array([wide.values_at(point) for point in points])
    np.testing.assert_allclose(values[0], [19.0, 0.02, 0.0], atol=1e-9)
    eighths = np.floor((values[1:, 0] - 4) / 7).astype(int)  # of a Latin hypercube, one in each
    assert sorted(eighths) == list(range(8))
    logs = np.floor(8 * np.log(values[1:, 1] / 0.001) / np.log(200)).astype(int)
    assert sorted(logs) == list(range(8))
    assert len(draw_start_points(wide.parameters, 1, seed=0)) == 1


def test_a_stopped_search_is_resumed_to_the_same_result(wide, tmp_path, monkeypatch):
    file = tmp_path / "search.npz"
    arguments = wide, wide.data.measured, 12, 1
    whole = multi_start(*arguments)

    class Stopped(Exception):
        pass

    def stopping(*given):
        if file.exists():
            raise Stopped
        return minimise(*given)

    minimise = wide.minimise
    monkeypatch.setattr(wide, "minimise", stopping)
    with pytest.raises(Stopped):
        multi_start(*arguments, Checkpoint(file, "this"))
    monkeypatch.undo()
    resumed = multi_start(*arguments, Checkpoint(file, "this"))
    assert [minimum.cost for minimum in resumed] == [minimum.cost for minimum in whole]
    np.testing.assert_array_equal(resumed[0].values, whole[0].values)
    with pytest.raises(ValueError, match="belongs to another search"):
        multi_start(*arguments, Checkpoint(file, "that"))


def test_identify_takes_the_lowest_minimum_and_resumes(tmp_path, monkeypatch):
    """All of `identify` with a formula for a dataset; from the start alone it would fail."""
    data = dataset()
    monkeypatch.setattr(sys.modules["tuning.fit.identify"], "make_dataset", lambda *given: data)
    bounds = {address: BOUNDS[address] for address in ADDRESSES}
    file = tmp_path / "search.npz"
    first = identify(CASE, data.logs, bounds, starts=12, seed=1, checkpoint=file)
    assert np.all(np.abs(first.values - VALUES) < 4 * first.errors)
    assert sum(minimum.starts for minimum in first.minima) == 12 and file.exists()
    assert "minima from 12 starts:" in str(first)
    with pytest.raises(FileExistsError, match="exists: resume that search, or delete it"):
        identify(CASE, data.logs, bounds, starts=12, seed=1, checkpoint=file)
    again = identify(CASE, data.logs, bounds, starts=12, seed=1, checkpoint=file, resume=True)
    np.testing.assert_array_equal(again.values, first.values)
    with pytest.raises(ValueError, match="belongs to another search"):
        identify(CASE, data.logs, bounds, starts=12, seed=2, checkpoint=file, resume=True)
    staged = identify(CASE, data.logs, list(TRUTH), stages=[["sensors.0.offset"]])
    np.testing.assert_allclose(staged.values, first.values, rtol=1e-5)
    with pytest.raises(ValueError, match="starts must be 1 or more, not 0"):
        identify(CASE, data.logs, bounds, starts=0)


# The Levenberg-Marquardt method against scipy, and derivatives of known numbers.

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
