"""Parameters of finite-element rigs recovered under autocorrelated noise by models of fewer modes.

They are fitted one by one, the others known, and all together; a wrong model is called unreliable.
"""

import numpy as np
import pytest
import scipy.stats

import jaxbeam as jb
from jaxbeam.case.case import replace
from tests.oracles import finite_elements
from tests.tuning.finite_element_rigs import (
    NOISE,
    RATE,
    SAGGING,
    SHAKER,
    YIELDING,
    Plant,
    SimulatedIdentification,
    autocorrelated,
    patch,
    plant,
)
from tests.well_compiled import well_compiled
from tuning import Log
from tuning.fit.dataset import make_dataset
from tuning.fit.least_squares import LeastSquares
from tuning.fit.uncertainty.covariance import t_quantile
from tuning.parameters.free import free_parameters, to_unbounded

THREE_ERRORS = 3 / 1.96  # half widths of an interval in three standard errors
SMALLEST_COUNT = 4  # parameters of the smallest rig

PLANTS = {
    "one span, shaker": plant(
        1,
        11.68,
        0.535,
        [jb.Shaker(**SHAKER)],
        [finite_elements.Suspension(*list(SHAKER.values())[:3])],
        {0.0: YIELDING, 0.6: YIELDING},
        [(0.15,), (0.35,)],
        modes=6,
    ),
    "one span, patch": plant(
        1,
        13.211,
        0.812,
        [patch(0.2575, 0.32)],
        [],
        {0.0: YIELDING, 0.6: YIELDING},
        [(0.2,), (0.3,)],
        modes=6,
    ),
    "two spans, patches": plant(
        2,
        12.277,
        0.7924,
        [patch(0.2575, 0.39), patch(0.8575, 0.68)],
        [],
        {0.6: SAGGING},
        [(0.3,), (0.9,)],
        modes=8,
    ),
}


@pytest.fixture(scope="module", params=PLANTS)
def identification(request) -> SimulatedIdentification:
    return SimulatedIdentification(PLANTS[request.param])


def test_all_parameters_together_lie_within_their_intervals(identification):
    """None is off by more than three standard errors; together, by the 99.9 % quantile."""
    free = np.ones(len(identification.truth), bool)
    solution = identification.fit(autocorrelated(identification.clean.shape, seed=0), free)
    assert solution.converged
    errors = identification.errors(solution, free)
    errors_by_address = dict(zip(identification.truth, errors, strict=True))
    assert np.all(np.abs(errors) < THREE_ERRORS), errors_by_address
    distance = errors @ np.linalg.solve(solution.uncertainty.correlation, errors) * 1.96**2
    assert distance < scipy.stats.chi2.ppf(0.999, errors.size), errors_by_address


def test_each_parameter_alone_lies_within_its_interval(identification):
    """Parameters of the beam, which all rigs have, on the rig with one patch only."""
    names = list(identification.truth)
    own = ("actuators", "supports")
    addresses = [n for n in names if n.startswith(own) or len(names) == SMALLEST_COUNT]
    for seed, name in enumerate(addresses):
        free = np.array([n == name for n in names])
        solution = identification.fit(autocorrelated(identification.clean.shape, seed + 1), free)
        assert solution.converged
        (error,) = identification.errors(solution, free)
        assert abs(error) < THREE_ERRORS, (name, error)


@pytest.mark.parametrize("identification", ["one span, patch"], indirect=True)
def test_intervals_of_a_wrong_model_are_called_unreliable(identification):
    """A rigidity fixed 10 % too high biases the other parameters; the fit warns of it."""
    noise = np.random.default_rng(0).normal(size=identification.clean.shape)
    free = np.array([name != "beam.flexural_rigidity" for name in identification.truth])
    right = identification.fit(noise, free)
    assert np.all(np.abs(identification.errors(right, free)) < THREE_ERRORS)
    assert right.converged and "unreliable" not in str(identification.result(noise, right))
    stiffer = to_unbounded(
        identification.parameters, [1.1 * x for x in identification.truth.values()]
    )
    wrong = identification.fit(noise, free, stiffer)
    assert np.any(np.abs(identification.errors(wrong, free)) > THREE_ERRORS)
    assert "unreliable" in str(identification.result(noise, wrong))


# Spring, damper and patch of a rig from planted logs: intervals hold the truth as often as stated.
#
# The logs are those of a finite-element beam that scipy integrates. In one a mass crosses while the
# voltage of the patch is logged, in the other it crosses without a command.

STIFFNESS, DAMPING = 3500.0, 40.0
REPEATS = 30
# Of thirty intervals that hold the truth with probability 0.95, fewer than 26 do so in one set of
# 64 (binomial distribution).
LEAST_COVERED = 26


@pytest.fixture(scope="module")
def rig() -> Plant:
    """A patch, and beside it a spring and damper to ground.

    The mass of the beam is weighed, and its own damping known: higher modes alone would
    separate it from the damper.
    """
    actuators = [
        jb.SpringDamper(0.5, stiffness=STIFFNESS, damping=DAMPING),
        patch(0.2575, 0.447),
    ]
    suspension = finite_elements.Suspension(0.5, STIFFNESS, DAMPING)
    sensors = [(0.15,), (0.3,), (0.45,)]
    made = plant(1, 12.7, 0.812, actuators, [suspension], {}, sensors, 12, "pinned-pinned")
    for known in ("beam.mass_per_length", "beam.damping_ratio"):
        del made.truth[known]
    return made


class PlantedFits:
    """Clean readings of both logs, and one least-squares problem for any noise."""

    def __init__(self, rig: Plant):
        times = np.arange(round(0.6 * RATE)) / RATE
        voltage = 2.0 * np.sin(2 * np.pi * 9.0 * times + 25.0 * times**2)
        commands = np.stack([voltage, 0 * voltage])
        self.clean = np.stack([rig.readings(times, own[:, None]) for own in commands])
        sensors = ("d1", "d2", "d3"), ("deflection",) * 3, ("m",) * 3
        with_voltage = (*sensors[0], "u"), (*sensors[1], "voltage"), (*sensors[2], "V")
        driven = Log(
            times,
            np.column_stack([self.clean[0], voltage]),
            *with_voltage,
            "driven",
            sensors=(0, 1, 2, None),
            actuators=(None, None, None, 1),
        )
        passive = Log(times, self.clean[1], *sensors, "passive", sensors=(0, 1, 2))
        self.truth = np.array(list(rig.truth.values()))
        start = {address: 1.1 * value for address, value in rig.truth.items()}
        dataset = make_dataset(replace(rig.case, start), [driven, passive])
        parameters = free_parameters(dataset.cases, dict.fromkeys(rig.truth), np.ptp(self.clean))
        self.problem = LeastSquares(dataset, parameters)

    def errors(self, seed: int) -> np.ndarray:
        """Errors of the parameters of a fit to noisy logs, in half widths of their intervals."""
        noise = np.random.default_rng(seed).normal(size=self.clean.shape)
        solution = self.problem.solve(self.clean + NOISE["deflection"] * noise)
        assert solution.converged
        half_widths = t_quantile(solution.degrees_of_freedom) * solution.uncertainty.errors
        # All are identified: known to some percent, the damper to a fifth.
        assert np.all(half_widths / self.truth < [0.02, 0.1, 0.3, 0.05])
        return (solution.values - self.truth) / half_widths


@pytest.fixture(scope="module")
def fits(rig):
    with well_compiled():
        yield PlantedFits(rig)


def test_three_logs(fits):
    errors = np.array([fits.errors(seed) for seed in range(3)])
    assert np.all(np.abs(errors) < 2.0), errors  # four standard errors


def test_intervals_of_thirty_logs_hold_the_truth(fits):
    assert scipy.stats.binom.cdf(LEAST_COVERED - 1, REPEATS, 0.95) == pytest.approx(
        1 / 64, rel=1e-2
    )
    errors = np.array([fits.errors(seed) for seed in range(REPEATS)])
    covered = np.sum(np.abs(errors) < 1, axis=0)
    assert np.all(covered >= LEAST_COVERED), covered
    # The mean error of thirty, in standard errors of a mean: no bias.
    assert np.all(np.abs(errors.mean(axis=0)) * 1.96 * np.sqrt(REPEATS) < 4), errors.mean(axis=0)
