"""The sampled regulator with an observer in its loop, against the product's gains and runs."""

import numpy as np
import pytest

import jaxbeam as jb
from experiments.thesis.cases import with_duration
from experiments.thesis.chapter5 import observer, observer_loop
from experiments.thesis.chapter5.regulator_limits import (
    COMMAND_WEIGHT,
    optimal_gain,
    with_active_shaker,
    with_other_shaker,
)
from experiments.thesis.chapter5.regulators import STATE_WEIGHTS
from jaxbeam import rigs

LOAD = {"loads.0.mass": observer.MASS, "loads.0.speed": observer.SPEED}
RIG = jb.replace(with_other_shaker(with_active_shaker(rigs.load("A"))), LOAD)
PERIOD = 5e-3


@pytest.fixture(scope="module")
def runs():
    """A run without control and one under the observed regulator."""
    gains = observer_loop.design(RIG, PERIOD, STATE_WEIGHTS, COMMAND_WEIGHT)
    return [
        observer_loop.simulate_observed(RIG, PERIOD, each, after_exit=0.1) for each in (None, gains)
    ]


def test_gain_is_that_of_the_sampled_regulator():
    gains = observer_loop.design(RIG, PERIOD, STATE_WEIGHTS, COMMAND_WEIGHT)
    expected = np.asarray(optimal_gain(RIG, PERIOD, STATE_WEIGHTS)[0])[0]
    np.testing.assert_allclose(gains.regulator, expected, rtol=1e-5)


def test_beam_without_control_is_that_of_the_integrator(runs):
    record = jb.simulate(with_duration(RIG, 1.3, 200.0))
    free = runs[0].deflection
    expected = np.asarray(record.deflection)
    peak = np.abs(expected).max()
    np.testing.assert_allclose(free, expected[: len(free)], atol=5e-3 * peak)


def test_at_5_ms_the_regulator_worsens_the_deflection_though_the_observer_is_right(runs):
    """As the thesis finds: not the observer is to blame, but the sampled gain (Figs 5.6, 5.7)."""
    uncontrolled, controlled = runs
    peaks = [np.abs(one.deflection[:, observer_loop.SENSOR]).max() for one in runs]
    assert peaks[1] > 1.1 * peaks[0]
    off = np.abs(controlled.states[:, 0] - controlled.estimates[:, 0]).max()
    assert off < 0.05 * np.abs(controlled.states[:, 0]).max()
    assert not np.any(uncontrolled.estimates) and not np.any(uncontrolled.commands)
