"""Weighing in motion, from logs of modal equations that share no code with jaxbeam."""

import dataclasses

import numpy as np
import pytest

from tests.oracles import modal_equations
from tests.oracles.loads import Load
from tests.tuning.fit.test_identify import deviations, log_of, one_span
from tuning.weighing.matching_pursuit import MatchingPursuit
from tuning.weighing.weigh import weigh

SPAN = modal_equations.Span(0.6, 11.68, 0.535, modes=3, damping_ratio=0.03)
TIMES = np.arange(301) / 250
CASE = one_span(duration=1.2, rate=250.0)


def crossing(loads, noise=1e-5):
    clean = modal_equations.respond(SPAN, loads, (0.15, 0.3), TIMES).deflection
    return log_of(TIMES, clean + noise * np.random.default_rng(0).normal(size=clean.shape))


TWO = [Load(0.5, 1.2, 0.1), Load(0.3, -1.6, 0.5)]


def test_matching_pursuit_is_close_without_dynamics():
    pursuit = MatchingPursuit(CASE, crossing(TWO), (0.8, 2.5), both_ways=True)
    match = pursuit.find(2)
    parameters = sorted([float(n.mass), float(n.speed), float(n.entry_time)] for n in match.loads)
    np.testing.assert_allclose(parameters, [[0.3, -1.6, 0.5], [0.5, 1.2, 0.1]], atol=0.05)
    assert match.residual_rms < 0.2 < 0.5 * pursuit.find(1).residual_rms


def test_two_loads_that_meet_on_the_beam():
    weighed = weigh(CASE, crossing(TWO), (0.8, 2.5))
    truth = {
        "loads.0.mass": 0.5, "loads.0.speed": 1.2, "loads.0.entry_time": 0.1,
        "loads.1.mass": 0.3, "loads.1.speed": -1.6, "loads.1.entry_time": 0.5,
        "sensors.0.offset": 0.0, "sensors.1.offset": 0.0,
    }  # fmt: skip
    assert len(weighed.loads) == 2
    assert weighed.load_counts == []  # the residuals are white noise
    assert np.all(np.abs(deviations(weighed.fit, truth)) < 3.5)
    assert weighed.fit.errors[0] < 0.01 and weighed.fit.errors[3] < 0.01  # kg
    assert str(weighed).startswith("2 loads found\nparameter ")
    assert weighed.to_dict()["loads"][1]["mass"]["value"] == pytest.approx(0.3, rel=0.02)


def test_logs_and_cases_that_cannot_be_weighed():
    log = crossing(TWO)
    with pytest.raises(ValueError, match="speeds must be 0 < low < high"):
        weigh(CASE, log, (2.0, 1.0))
    with pytest.raises(ValueError, match="weighing needs a sensor on the beam; the case has none"):
        weigh(dataclasses.replace(CASE, sensors=()), log, (1.0, 2.0))
    free = dataclasses.replace(CASE.beam, ends="free-free")
    with pytest.raises(ValueError, match="rigid body"):
        weigh(dataclasses.replace(CASE, beam=free), log, (1.0, 2.0))
    upwards = dataclasses.replace(log, values=np.abs(log.values))
    with pytest.raises(ValueError, match="no load is found in it at these speeds"):
        weigh(CASE, upwards, (1.0, 2.0))
