"""Hysteresis identified from logs of planted play operators."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import tuning
from tests.case.test_hysteresis import OPERATOR, by_hand
from tuning.fit.hysteresis import fitted_hysteresis

TURNS = np.array([0.0, 2.0, -1.0, 4.0, -3.0, 5.0, 0.0])
COMMANDS = np.interp(np.linspace(0, 6, 121), np.arange(7), TURNS)
GAIN, OFFSET = -2e-5, 1e-4


def log_of(readings, commands=COMMANDS):
    values = np.stack([commands, readings], axis=1)
    names, kinds, units = ("u", "w"), ("voltage", "deflection"), ("V", "m")
    return tuning.Log(0.1 * np.arange(len(commands)), values, names, kinds, units)


def test_planted_operator_is_found():
    """Scaled so that the first excursion to 5 V reaches 5 V."""
    outputs = np.array(by_hand(COMMANDS))
    found = fitted_hysteresis(
        log_of(OFFSET + GAIN * outputs), "u", "w", np.array([0.0, 0.5, 1.5, 3.0])
    )
    scale = (0.7 * 5 + 0.15 * 4.5 + 0.1 * 3.5 + 0.15 * 2) / 5
    assert_allclose(found.hysteresis.weights, np.array(OPERATOR.weights) / scale, rtol=1e-9)
    assert_allclose([found.gain, found.offset], [GAIN * scale, OFFSET], rtol=1e-9)
    assert_allclose(found.hysteresis.first_output(np.asarray(5.0)), 5.0)


def test_other_thresholds_and_noise():
    """With the thresholds not known and noise of 1 % of the stroke, its inverse leaves little."""
    outputs = np.array(by_hand(COMMANDS))
    noise = 1e-6 * np.random.default_rng(1).normal(size=len(COMMANDS))
    found = fitted_hysteresis(log_of(GAIN * outputs + noise), "u", "w")
    assert found.residual < 1.1e-6 < found.linear_residual / 4
    wanted = 3 * np.sin(np.linspace(0, 9, 200))
    acting = OPERATOR.outputs(found.hysteresis.inverse().outputs(wanted)) * GAIN / found.gain
    assert np.std(acting - wanted) < np.std(OPERATOR.outputs(wanted) - wanted) / 4


@pytest.mark.parametrize(
    ("arguments", "commands", "message"),
    [
        (("x", "w"), COMMANDS, "the log has no channel 'x'; it has u, w"),
        (("u", "w"), np.ones(121), "commands 'u' are constant"),
        (("u", "w", np.array([0.1])), COMMANDS, "thresholds must begin with 0"),
    ],
)
def test_errors(arguments, commands, message):
    with pytest.raises(ValueError, match=message):
        fitted_hysteresis(log_of(COMMANDS, commands), *arguments)
