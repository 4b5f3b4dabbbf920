"""Parameters of finite-element rigs recovered under autocorrelated noise by models of fewer modes.

They are fitted one by one, the others known, and all together; a wrong model is called unreliable.
"""

import numpy as np
import pytest
import scipy.stats

import jaxbeam as jb
from tests.oracles import finite_elements
from tests.tuning.finite_element_rigs import (
    SAGGING,
    SHAKER,
    YIELDING,
    SimulatedIdentification,
    autocorrelated,
    patch,
    plant,
)
from tuning.parameters.free import to_unbounded

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
