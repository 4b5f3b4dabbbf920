"""Uncertainty of a fit, against normal equations and residuals of known autocorrelation."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.case import replace
from tests.differences import well_compiled
from tests.oracles import modal_equations
from tests.oracles.crossing import Load
from tests.tuning.fit.test_identify import NOISE, simulated_log, small
from tuning.fit.dataset import make_dataset
from tuning.fit.experiment_design import design_experiment
from tuning.fit.least_squares import (
    REPORTED_CHANGE,
    UNBOUNDED_SD,
    LeastSquares,
    autocorrelation_factor,
    t_quantile,
    uncertainty,
)
from tuning.fit.result import fit_result
from tuning.parameters import free_parameters

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


# The best position of a sensor, against modal equations and differences on a grid.

SPAN = modal_equations.Span(0.6, 11.68, 0.535, modes=2, damping_ratio=0.03)
CASE = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03,
            modes=2),
    sensors=[jb.Sensor(0.12)],
    loads=[jb.MovingMass(mass=0.5, speed=2.0, entry_time=0.02)],
    run=jb.Run(duration=0.4, sample_rate=200.0),
)  # fmt: skip
FREE = ["beam.flexural_rigidity", "beam.mass_per_length"]


def errors_by_differences(positions, noise):
    """Standard errors of rigidity and mass per length, by position of one sensor."""
    times = np.arange(81) / 200.0

    def respond(**changes):
        span = dataclasses.replace(SPAN, **changes)
        return modal_equations.respond(span, [Load(0.5, 2.0, 0.02)], positions, times).deflection

    step = 1e-4
    slopes = np.stack([
        (respond(**{name: value * (1 + step)}) - respond(**{name: value * (1 - step)}))
        / (2 * step * value)
        for name, value in (("flexural_rigidity", 11.68), ("mass_per_length", 0.535))
    ], axis=-1)  # fmt: skip
    information = np.einsum("tpi,tpj->pij", slopes, slopes) / noise**2
    return np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))


def test_the_best_sensor_position_for_the_mass():
    bounds = (0.05, 0.55)
    design = design_experiment(
        CASE, FREE, {"sensors.0.position": bounds}, target=FREE[1], noise=2e-5
    )
    positions = np.linspace(*bounds, 101)
    grid = errors_by_differences(positions, 2e-5)
    np.testing.assert_allclose(
        design.errors_before, errors_by_differences(np.array([0.12]), 2e-5)[0], rtol=1e-3
    )
    best = int(np.argmin(grid[:, 1]))
    assert design.after[0] == pytest.approx(positions[best], abs=0.005)
    assert design.errors_after[1] == pytest.approx(grid[best, 1], rel=2e-3)
    assert design.errors_after[1] < design.errors_before[1]
    near = errors_by_differences(np.array([0.1195, 0.1205]), 2e-5)[:, 1]
    assert design.error_sensitivities[1, 0] == pytest.approx(
        np.diff(np.log(near))[0] / 1e-3, rel=0.02
    )
    assert str(design).startswith("sensors.0.position: 0.12 -> ")
    assert float(design.case.sensors[0].position) == design.after[0]


@pytest.mark.parametrize(
    "given, words",
    [
        ({"over": {}}, "name at least one number to choose"),
        ({"target": "beam.length"}, "the target beam.length is not free"),
        ({"over": {FREE[0]: (5.0, 20.0)}}, "cannot be both fitted and chosen"),
        ({"over": {"loads.0.speed": (3.0, 4.0)}}, "loads.0.speed is 2, outside its bounds"),
        ({"over": {"loads.0.sped": (3.0, 4.0)}}, "did you mean 'loads.0.speed'"),
    ],
)
def test_faulty_designs(given, words):
    with pytest.raises(ValueError, match=words):
        design_experiment(
            **{"case": CASE, "free": FREE, "over": {"loads.0.speed": (1.0, 4.0)}} | given
        )


# 95 % intervals cover the true values in 95 % of many simulated logs.

# One sensor, two modes, few samples: small enough for hundreds of fits.
SMALL = {
    "beam.flexural_rigidity": 11.68,
    "beam.mass_per_length": 0.535,
    "beam.damping_ratio": 0.03,
    "sensors.0.offset": 0.0,
    "loads.0.speed": 2.0,
    "loads.0.entry_time": 0.05,
}
STARTS = {"beam.flexural_rigidity": 11.0, "beam.damping_ratio": 0.02, "loads.0.speed": 2.05}


class RepeatedFits:
    """Many logs of one rig, fitted by one compiled problem with starts near the true values.

    The mass of the load is held at its true value unless a test frees it.
    """

    def __init__(self):
        self.case = small(duration=0.5, rate=250.0)
        self.clean = np.asarray(jb.simulate(self.case).measured)
        log = simulated_log(self.case, NOISE)
        dataset = make_dataset(replace(self.case, STARTS), [log])
        free = dict.fromkeys([*SMALL, "loads.0.mass"])
        parameters = free_parameters(dataset.cases, free, np.ptp(self.clean))
        self.least_squares = LeastSquares(dataset, parameters)

    def deviations(self, noises):
        """Errors in half widths of the intervals (log, parameter), and the standard errors."""
        free = np.arange(7) < 6
        problem = self.least_squares
        solutions = [problem.solve((self.clean + noise)[None], free=free) for noise in noises]
        errors = np.array([each.uncertainty.errors[:6] for each in solutions])
        values = np.array([each.values[:6] for each in solutions])
        assert all(each.converged for each in solutions)
        half_widths = errors * np.array(
            [[t_quantile(each.degrees_of_freedom)] for each in solutions]
        )
        return (values - list(SMALL.values())) / half_widths, errors


@pytest.fixture(scope="module")
def repeated_fits():
    """The least-squares problem, compiled with optimisation: it is solved six hundred times."""
    problem = RepeatedFits()
    with well_compiled():
        yield problem


def autocorrelated(white, memory: float):
    """A first-order process of the same power as the white noise (log, time, channel)."""
    noise = np.array(white)
    for i in range(1, noise.shape[1]):
        noise[:, i] = memory * noise[:, i - 1] + np.sqrt(1 - memory**2) * white[:, i]
    return noise


def test_intervals_cover_the_truth(repeated_fits):
    noises = NOISE * np.random.default_rng(5).normal(size=(500, *repeated_fits.clean.shape))
    errors, _ = repeated_fits.deviations(noises)
    covered = np.mean(np.abs(errors) < 1, axis=0)
    assert np.all((covered >= 0.92) & (covered <= 0.97)), dict(zip(SMALL, covered, strict=True))
    assert np.all(np.abs(np.mean(errors, axis=0)) < 3 / 1.96 / np.sqrt(500))


def test_autocorrelated_residuals_widen_intervals(repeated_fits):
    white = NOISE * np.random.default_rng(6).normal(size=(100, *repeated_fits.clean.shape))
    _, narrow = repeated_fits.deviations(white[:10])
    errors, wide = repeated_fits.deviations(autocorrelated(white, 0.6))
    widening = np.median(wide, axis=0) / np.median(narrow, axis=0)
    np.testing.assert_allclose(widening, 2.0, rtol=0.25)  # sqrt((1 + r) / (1 - r))
    covered = np.mean(np.abs(errors) < 1, axis=0)
    assert np.all(covered >= 0.90), dict(zip(SMALL, covered, strict=True))


def test_a_common_factor_is_reported_as_unidentifiable():
    """Rigidity, mass per length and load mass times a factor lead to the same deflection."""
    repeated_fits = RepeatedFits()  # solved once, for which optimising takes too long
    scaled = ["beam.flexural_rigidity", "beam.mass_per_length", "loads.0.mass"]
    noise = NOISE * np.random.default_rng(0).normal(size=repeated_fits.clean.shape)
    problem = repeated_fits.least_squares
    fit = fit_result(
        repeated_fits.case, problem, problem.solve((repeated_fits.clean + noise)[None])
    )
    (direction,) = fit.unidentifiable
    assert set(direction) == set(scaled)
    values = dict(zip(fit.addresses, fit.values, strict=True))
    shares = [direction[address] / values[address] for address in scaled]
    np.testing.assert_allclose(shares, shares[0], rtol=0.02)
    unidentifiable = [address in scaled for address in fit.addresses]
    assert np.isinf(fit.errors).tolist() == unidentifiable
    assert np.isinf(fit.intervals[unidentifiable]).all()
    assert str(fit).count("not identifiable\n") == 3
    assert fit.to_dict()["numbers"]["loads.0.mass"]["interval_95"] is None
