"""Logs that finite elements made, and what is found in them of the numbers fitted by hand."""

import numpy as np
import pytest

from experiments.thesis.chapter2.identification import HAND_FITTED, LOGS, fit_rig
from jaxbeam import rigs
from tests.tuning import make_rig_logs


@pytest.mark.slow
def test_one_patch():
    """The committed log is the one that is made here, and the fit's intervals hold the truth."""
    kept = np.loadtxt(LOGS / "B.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(kept, make_rig_logs.make("B"), atol=2e-5)
    assert (LOGS / "B.toml").read_text(encoding="utf-8") == make_rig_logs.beside("B")
    found = fit_rig("B", rigs.load)
    low, high = found.intervals.T
    truth = np.array(list(HAND_FITTED["B"].values()))
    assert np.all((low < truth) & (truth < high)), str(found)
    assert np.all(high - low < 0.1 * truth)
