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
FED_BACK_COUNT, STATE_COUNT = 1, 4


@pytest.fixture(scope="module")
def regulated():
    """Two modes under a regulator with weights set by hand."""
    law = jb.LQR(state_weight=[1e4, 1e4, 1.0, 1.0], command_weight=[1e-3], period=0.01)
    case = rig(law)
    return dataclasses.replace(case, beam=dataclasses.replace(case.beam, modes=2))


def test_the_states_selected_are_the_best_of_all_choices(regulated):
    reduced = tuning.tune_reduced(regulated, FED_BACK_COUNT, FREE, CASES, **OPTIONS)
    objectives = {}
    for fed_back in itertools.combinations(range(STATE_COUNT), FED_BACK_COUNT):
        shares = np.isin(np.arange(STATE_COUNT), fed_back).astype(float)
        law = dataclasses.replace(regulated.controller, feedback=shares)
        one = tuning.tune(dataclasses.replace(regulated, controller=law), FREE, CASES, **OPTIONS)
        objectives[fed_back] = one.run_sets[0].objective[1]
    assert reduced.fed_back == min(objectives, key=objectives.get)
    rounded, end = reduced.tuned.run_sets[0].objective
    assert end <= rounded and end < 1.002 * objectives[reduced.fed_back]
    # The choice matters, and the sum of the shares is as required.
    assert max(objectives.values()) > 1.05 * end
    assert reduced.shares.sum() == pytest.approx(FED_BACK_COUNT, abs=0.05)
    np.testing.assert_array_equal(
        np.asarray(reduced.tuned.case.controller.feedback),
        np.isin(range(STATE_COUNT), reduced.fed_back),
    )
    assert "when the other parameters are tuned again" in str(reduced)


def test_wrong_controllers_and_numbers_of_states_are_refused(regulated):
    with pytest.raises(ValueError, match="only regulators, such as kind 'lqr'"):
        tuning.tune_reduced(rig(), 1, FREE, CASES)
    with pytest.raises(ValueError, match="keep must be 1 to 3 of the 4 states; it is 4"):
        tuning.tune_reduced(regulated, 4, FREE, CASES)
    with pytest.raises(ValueError, match="leave controller.feedback out of what is free"):
        tuning.tune_reduced(regulated, 2, {"controller.feedback.0": None}, CASES)
