"""Answers of cases of all kinds are those of version 0.2.0."""

import json
import pathlib

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from tests.simulation.release_cases import CASES, OTHER_STEPS, answers

KEPT = json.loads((pathlib.Path(__file__).parents[1] / "data/release_0_2_0.json").read_text())
TOLERANCE = 1e-9  # relative to the largest entry of each array
pytestmark = pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")


@pytest.mark.parametrize("name", CASES)
def test_answers_are_those_of_version_0_2_0(name):
    found = answers(name)
    assert found.keys() == KEPT[name].keys()
    for part, kept in KEPT[name].items():
        ours, theirs = np.array(found[part], float), np.array(kept, float)
        scale = np.max(np.abs(theirs), initial=0.0, where=np.isfinite(theirs))
        assert_allclose(ours, theirs, rtol=0, atol=TOLERANCE * scale, err_msg=part)


@pytest.mark.parametrize("name", OTHER_STEPS)
def test_peaks_of_other_steps_differ_by_the_stated_error(name):
    record, kept = jb.simulate(CASES[name]), np.array(KEPT[name]["peaks"])
    stated = 1.5 * float(record.error_estimate) * kept.max()
    assert_allclose(record.peak_deflection, kept, rtol=0, atol=stated)
