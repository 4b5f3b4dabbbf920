"""95 % intervals cover the true values in 95 % of many simulated logs."""

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.case import replace
from tests.tuning.fit.test_identify import NOISE, simulated_log, small
from tests.well_compiled import well_compiled
from tuning.fit.dataset import make_dataset
from tuning.fit.least_squares import LeastSquares
from tuning.fit.result import fit_result
from tuning.fit.uncertainty.covariance import t_quantile
from tuning.parameters.free import free_parameters

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
