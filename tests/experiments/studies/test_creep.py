"""Creep identified from logs of planted operators, integrated by scipy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from experiments.studies.creep import fitted_creep, lags_of
from jaxbeam.simulation.commands import command_operator
from tests.case.test_creep import acting
from tests.case.test_hysteresis import OPERATOR, by_hand
from tests.tuning.fit.test_hysteresis import log_of

RATES, WEIGHTS = np.array([2.0, 0.2]), np.array([0.08, 0.05])
# Ramps with plateaus, of 20 s together, sampled at 10 Hz.
TURNS = np.array([0.0, 2.0, 2.0, -1.0, -1.0, 4.0, 4.0, -3.0, 5.0, 5.0, 0.0])
TIMES = 0.1 * np.arange(201)
COMMANDS = np.interp(TIMES, 2.0 * np.arange(11), TURNS)
GAIN, OFFSET = -2e-5, 1e-4


def planted(commands=COMMANDS):
    """Readings behind hysteresis and creep, the lags by scipy."""
    at_once = np.array(by_hand(commands))

    def rates(t, z):
        return RATES * (np.interp(t, TIMES, at_once) - z)

    options = {"t_eval": TIMES, "rtol": 1e-9, "atol": 1e-11, "max_step": 0.1}
    lags = solve_ivp(rates, (0, TIMES[-1]), np.zeros(2), **options).y
    return OFFSET + GAIN * (at_once + WEIGHTS @ lags), lags.T


def test_lags_between_samples():
    at_once = np.array(by_hand(COMMANDS))
    assert_allclose(lags_of(RATES, TIMES, at_once), planted()[1], atol=1e-7)


def test_planted_operators_are_found():
    readings, _ = planted()
    found = fitted_creep(
        log_of(readings, COMMANDS), "u", "w", RATES, np.array([0.0, 0.5, 1.5, 3.0])
    )
    scale = OPERATOR.first_output(np.asarray(5.0)) / 5
    assert_allclose(found.creep.weights, WEIGHTS, rtol=1e-3)
    assert_allclose(found.hysteresis.weights, OPERATOR.weights / scale, rtol=1e-3)
    assert_allclose([found.gain, found.offset], [GAIN * scale, OFFSET], rtol=1e-3)
    assert found.residual < 1e-4 * found.linear_residual


def test_other_rates_and_noise_leave_little():
    """With default rates and thresholds: twice the noise; a quarter of the drift at most is left.

    Drift of a held command of 2 V over 20 s, straight and through the inverse that was found.
    """
    readings, _ = planted()
    noise = 2e-7 * np.random.default_rng(3).normal(size=TIMES.size)
    found = fitted_creep(log_of(readings + noise, COMMANDS), "u", "w")
    assert found.residual < 4e-7 < found.linear_residual / 10
    period, held = np.asarray(0.1), np.full(200, 2.0)
    true = command_operator(OPERATOR, jb.Creep(RATES, WEIGHTS), period)
    fitted = command_operator(found.hysteresis, found.creep, period)
    sent, _ = acting(fitted.inverse(), held)
    drifts = [np.ptp(acted) / acted[-1] for acted in (acting(true, held)[0], acting(true, sent)[0])]
    assert drifts[0] > 0.1 and drifts[1] < drifts[0] / 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("x", "w"), "the log has no channel 'x'; it has u, w"),
        (("u", "w", np.array([-1.0])), "rates of creep must be positive"),
        (("u", "w", None, np.array([0.1])), "thresholds must begin with 0"),
    ],
)
def test_errors(arguments, message):
    with pytest.raises(ValueError, match=message):
        fitted_creep(log_of(COMMANDS, COMMANDS), *arguments)
