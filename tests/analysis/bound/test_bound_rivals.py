"""The bound is below feedback, predictive, feedforward, internal-model and sliding-mode control."""

import dataclasses

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

import jaxbeam as jb
from jaxbeam.analysis.bound.bound import bound
from jaxbeam.simulation.integration_plan import integration_plan

PERIOD = 0.02
CASE = jb.Case(
    jb.Beam(0.6, 13.211, 0.812, 0.03, modes=2),
    actuators=[
        jb.Patch(0.2575, 0.3425, 8.292e-4, correction=0.4, amplifier_gain=200.0, limits=[-2.5, 7.5])
    ],
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.4, speed=2.0)],
    run=jb.Run(0.4, sample_rate=250.0),
)
SHARES, DEPTHS = np.linspace(0, 1, 5), np.linspace(-2e-3, 0, 4)
LAWS = {
    "feedback": jb.Feedback([1.0], 1, [[1.0]], period=PERIOD),
    "mpc": jb.MPC(4, 2, 1e-10, period=PERIOD, loads="known"),
    "feedforward": jb.Feedforward([-0.2, -0.1], SHARES, np.ones((1, 5)), period=PERIOD),
    "internal-model": jb.InternalModel(DEPTHS, np.ones((1, 4)), period=PERIOD),
    "sliding-mode": jb.SlidingMode(30.0, reaching_rate=20.0, layer=1.0, period=PERIOD),
    "gpc": jb.GPC(4, 2, 1e-10, period=PERIOD),
}
CASES = {name: dataclasses.replace(CASE, controller=law) for name, law in LAWS.items()}


@pytest.fixture(scope="module")
def plans():
    return {name: integration_plan(case, None, 1e-6) for name, case in CASES.items()}


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
@settings(max_examples=12)
@given(
    mass=st.floats(0.05, 0.8),
    speed=st.floats(1.6, 4.0),
    strength=st.floats(2.0, 5.0),
    weight=st.floats(-12.0, -7.0),
    commands=st.lists(st.floats(-2.5, 7.5), min_size=5, max_size=5),
)
def test_no_controller_is_below_the_bound(plans, mass, speed, strength, weight, commands):
    """Random settings of each controller under a random load, with equal periods."""
    load = {"loads.0.mass": mass, "loads.0.speed": speed}
    least = bound(jb.replace(CASE, load), period=PERIOD)
    numbers = {
        "feedback": {
            "controller.gains.0": 10**strength,
            "controller.higher_gains.0.0": 10 ** (strength + 6),
        },
        "mpc": {"controller.move_weight": 10**weight},
        "feedforward": {"controller.values": np.array([commands])},
        "internal-model": {"controller.values": np.array([commands[:4]])},
        "sliding-mode": {"controller.layer": strength / 4},
        "gpc": {"controller.move_weight": 10**weight},
    }
    reached = []
    for name, case in CASES.items():
        record = jb.simulate(jb.replace(case, load | numbers[name]), plan=plans[name])
        if not np.all(np.isfinite(record.deflection)):
            continue  # the loop diverges
        assert np.max(np.abs(record.deflection)) >= least.peak * (1 - 1e-6), name
        reached.append(least.share(record))
    assert reached and max(reached) <= 1 + 1e-6


def test_predictive_control_comes_near_the_bound(plans):
    """The inequality above is not met by poor controllers only."""
    case = jb.replace(CASES["mpc"], {"controller.move_weight": 1e-12})
    record = jb.simulate(case, plan=plans["mpc"])
    assert 2 / 3 < bound(CASE, period=PERIOD).share(record) <= 1 + 1e-6
