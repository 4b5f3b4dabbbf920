"""Parameters of finite-element rigs are recovered under coloured noise, by models of fewer modes.

They are fitted one by one, the others known, and all together; a wrong model is called unreliable.
"""

import numpy as np
import pytest
import scipy.stats

import jaxbeam as jb
from tests.oracles import finite_elements
from tests.tuning.rehearsals import (
    SAGGING,
    SHAKER,
    YIELDING,
    Rehearsal,
    coloured,
    patch,
    plant,
)
from tuning.parameters.free import to_unbounded

WIDE = 3 / 1.96  # half widths of an interval in three standard errors
FEWEST = 4  # parameters of the smallest rig

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
def rehearsal(request) -> Rehearsal:
    return Rehearsal(PLANTS[request.param])


@pytest.mark.slow
def test_all_parameters_together_lie_within_their_intervals(rehearsal):
    """None is off by more than three standard errors; together, by the 99.9 % quantile."""
    free = np.ones(len(rehearsal.truth), bool)
    found = rehearsal.fit(coloured(rehearsal.clean.shape, seed=0), free)
    assert found.converged
    errors = rehearsal.errors(found, free)
    said = dict(zip(rehearsal.truth, errors, strict=True))
    assert np.all(np.abs(errors) < WIDE), said
    distance = errors @ np.linalg.solve(found.uncertainty.correlation, errors) * 1.96**2
    assert distance < scipy.stats.chi2.ppf(0.999, errors.size), said


@pytest.mark.slow
def test_each_parameter_alone_lies_within_its_interval(rehearsal):
    """Parameters of the beam, which all rigs have, on the rig with one patch only."""
    names = list(rehearsal.truth)
    own = ("actuators", "supports")
    wanted = [n for n in names if n.startswith(own) or len(names) == FEWEST]
    for seed, name in enumerate(wanted):
        free = np.array([n == name for n in names])
        found = rehearsal.fit(coloured(rehearsal.clean.shape, seed + 1), free)
        assert found.converged
        (error,) = rehearsal.errors(found, free)
        assert abs(error) < WIDE, (name, error)


@pytest.mark.slow
@pytest.mark.parametrize("rehearsal", ["one span, patch"], indirect=True)
def test_intervals_of_a_wrong_model_are_called_unreliable(rehearsal):
    """A rigidity held 10 % too high biases the other parameters; the fit says so."""
    noise = np.random.default_rng(0).normal(size=rehearsal.clean.shape)
    free = np.array([name != "beam.flexural_rigidity" for name in rehearsal.truth])
    right = rehearsal.fit(noise, free)
    assert np.all(np.abs(rehearsal.errors(right, free)) < WIDE)
    assert right.converged and "unreliable" not in str(rehearsal.result(noise, right))
    stiffer = to_unbounded(rehearsal.parameters, [1.1 * x for x in rehearsal.truth.values()])
    wrong = rehearsal.fit(noise, free, stiffer)
    assert np.any(np.abs(rehearsal.errors(wrong, free)) > WIDE)
    assert "unreliable" in str(rehearsal.result(noise, wrong))
