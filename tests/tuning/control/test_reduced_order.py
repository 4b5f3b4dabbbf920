"""States to feed back: selection by relaxed shares, against every choice."""

import dataclasses
import itertools

import numpy as np
import pytest

import jaxbeam as jb
import tuning
from tests.tuning.small_rig import rig

FREE = {"controller.command_weight.0": (1e-5, 1e-1)}
CASES = tuning.LoadCases(({"loads.0.mass": 0.3}, {"loads.0.mass": 0.5}))
OPTIONS = {"steps": 30, "least_peaks": False, "progress": False}
KEEP, STATES = 1, 4


@pytest.fixture(scope="module")
def regulated():
    """Two modes under a regulator with weights set by hand."""
    law = jb.LQR(state_weight=[1e4, 1e4, 1.0, 1.0], command_weight=[1e-3], period=0.01)
    case = rig(law)
    return dataclasses.replace(case, beam=dataclasses.replace(case.beam, modes=2))


@pytest.mark.slow
def test_the_states_selected_are_the_best_of_all_choices(regulated):
    found = tuning.tune_reduced(regulated, KEEP, FREE, CASES, **OPTIONS)
    ends = {}
    for fed_back in itertools.combinations(range(STATES), KEEP):
        shares = np.isin(np.arange(STATES), fed_back).astype(float)
        law = dataclasses.replace(regulated.controller, feedback=shares)
        one = tuning.tune(dataclasses.replace(regulated, controller=law), FREE, CASES, **OPTIONS)
        ends[fed_back] = one.run_sets[0].objective[1]
    assert found.fed_back == min(ends, key=ends.get)
    rounded, end = found.tuned.run_sets[0].objective
    assert end <= rounded and end < 1.002 * ends[found.fed_back]
    # The choice matters, and the sum of the shares is as required.
    assert max(ends.values()) > 1.05 * end
    assert found.shares.sum() == pytest.approx(KEEP, abs=0.05)
    np.testing.assert_array_equal(
        np.asarray(found.tuned.case.controller.feedback), np.isin(range(STATES), found.fed_back)
    )
    assert "when the other parameters are tuned again" in str(found)


def test_wrong_controllers_and_numbers_of_states_are_refused(regulated):
    with pytest.raises(ValueError, match="only regulators, such as kind 'lqr'"):
        tuning.tune_reduced(rig(), 1, FREE, CASES)
    with pytest.raises(ValueError, match="keep must be 1 to 3 of the 4 states; it is 4"):
        tuning.tune_reduced(regulated, 4, FREE, CASES)
    with pytest.raises(ValueError, match="leave controller.feedback out of what is free"):
        tuning.tune_reduced(regulated, 2, {"controller.feedback.0": None}, CASES)
