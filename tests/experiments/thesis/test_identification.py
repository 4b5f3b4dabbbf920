"""Identification of the numbers fitted by hand, from logs made by finite elements."""

import numpy as np

from experiments.thesis.chapter2.identification import HAND_FITTED, LOGS, fit_rig
from jaxbeam import rigs
from tests.tuning import make_rig_logs


def test_intervals_of_rig_b_contain_the_true_values():
    """The log in the repository is the one that `make_rig_logs` makes."""
    stored = np.loadtxt(LOGS / "B.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(stored, make_rig_logs.make("B"), atol=2e-5)
    assert (LOGS / "B.toml").read_text(encoding="utf-8") == make_rig_logs.description("B")
    fit = fit_rig("B", rigs.load)
    low, high = fit.intervals.T
    truth = np.array(list(HAND_FITTED["B"].values()))
    assert np.all((low < truth) & (truth < high)), str(fit)
    assert np.all(high - low < 0.1 * truth)
