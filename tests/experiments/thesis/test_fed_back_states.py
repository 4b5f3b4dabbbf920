"""Statements on the states fed back, and on both gains of chapter 3, from given peaks and gains."""

import numpy as np

from experiments.thesis.chapter5.fed_back_states import (
    BUT_FOR_THE_END,
    COMBINATIONS,
    FED_BACK,
    SHARES,
    claims,
    identical_gains,
)
from experiments.thesis.verdicts import LITERAL, NOT_REPRODUCED, REPRODUCED, assign_verdicts


def ratios(varying, invariant):
    """Peaks in percent by combination: those given, 90 for the others."""
    return {
        LITERAL: {
            "time-varying": np.array([varying.get(name, 90.0) for name in COMBINATIONS]),
            "time-invariant": np.array([invariant.get(name, 90.0) for name in COMBINATIONS]),
        }
    }


def test_statements_hold_or_not():
    as_printed = ratios({"q1 q2": 84.0, "q1 q2 q1'": 83.0, "q1": 85.0}, {"all": 101.0})
    assert assign_verdicts([claims(as_printed)])[0].verdicts == [REPRODUCED] * 3
    opposite = ratios({"q1 q2": 86.0, "q1 q2 q1'": 87.0, "q1": 85.0}, {"all": 99.0})
    assert assign_verdicts([claims(opposite)])[0].verdicts == [NOT_REPRODUCED] * 3
    diverging = claims(ratios({}, {"all": np.nan})).interpretations[LITERAL]
    assert diverging.tolist() == [0.0, 0.0, 1.0]


def test_difference_of_gains_in_percent_of_the_largest():
    finite = np.outer(np.ones(SHARES.size), np.arange(1.0, FED_BACK.size + 1))
    step = finite.copy()
    step[100, 1] += 0.01  # half a percent of the gain of the second state
    step[-1, 0] = 0.0  # at the end of the crossing
    found = identical_gains({"finite-time": finite, "step-by-step": step, "constant": 2 * finite})
    np.testing.assert_allclose(found.interpretations[LITERAL], 100.0)
    np.testing.assert_allclose(found.interpretations[BUT_FOR_THE_END], 0.5)
    np.testing.assert_allclose(found.null.values, 100.0)
