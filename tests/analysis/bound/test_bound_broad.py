"""The bound under several loads, with several kinds of actuators, over the whole beam."""

import dataclasses

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

import jaxbeam as jb
from jaxbeam.analysis.bound.bound import bound
from jaxbeam.simulation.integration_plan import integration_plan

PERIOD = 0.01
BEAM_POSITIONS = np.linspace(0.05, 1.15, 23)
# Two patches, each with a sensor above it, and a shaker with a suspension under the second span.
PATCHES = [
    jb.Patch(x, x + 0.085, 8.292e-4, correction=0.39, amplifier_gain=200.0, limits=[-2.5, 7.5])
    for x in (0.2575, 0.8575)
]
SHAKER = jb.Shaker(1.0, 500.0, 5.0, force_per_volt=4.6, bandwidth=500.0, limits=[-0.5, 0.5])
CASE = jb.Case(
    jb.Beam(1.2, 12.277, 0.7924, 0.03, modes=4),
    [jb.Support(0.6)],
    [*PATCHES, SHAKER],
    [jb.Sensor(0.3), jb.Sensor(0.9), jb.Sensor(1.0)],
    [jb.MovingMass(mass=0.4, speed=2.0), jb.MovingMass(mass=0.2, speed=2.0, entry_time=0.2)],
    jb.StateFeedback(np.ones((3, 9)), period=PERIOD),
    jb.Run(0.6, sample_rate=500.0),
)


@pytest.fixture(scope="module")
def plan():
    return integration_plan(CASE)


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
@settings(max_examples=6)
@given(
    masses=st.tuples(st.floats(0.05, 0.8), st.floats(0.05, 0.8)),
    speed=st.floats(1.5, 4.0),
    gap=st.floats(0.0, 0.3),
    strength=st.floats(1.0, 5.0),
    everywhere=st.booleans(),
    seed=st.integers(0, 10**6),
)
def test_no_state_feedback_is_below_the_bound(plan, masses, speed, gap, strength, everywhere, seed):
    """Loads at once or one after the other; random state feedback, saturated."""
    gain = np.random.default_rng(seed).standard_normal((3, 9)) * 10**strength
    gain[:, 4:] *= 0.01  # rates in m/s, and the force of the shaker, beside deflections in m
    numbers = {"controller.gain": gain, "loads.1.entry_time": gap}
    for i, mass in enumerate(masses):
        numbers |= {f"loads.{i}.mass": mass, f"loads.{i}.speed": speed}
    case = jb.replace(CASE, numbers)
    positions = BEAM_POSITIONS if everywhere else None
    record = jb.simulate(case, plan=plan)
    least = bound(case, positions)
    deflection = record.deflection if positions is None else record.at(positions)
    assert np.max(np.abs(deflection)) >= least.peak * (1 - 1e-6)
    assert least.share(record) <= 1 + 1e-6
    assert 0 < least.reduction < 1


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_commands_attain_the_bound_on_the_whole_beam():
    """To 1e-3: the change of the deflection between the times of the bound."""
    least = bound(CASE, BEAM_POSITIONS)
    record = jb.simulate(dataclasses.replace(CASE, controller=least.controller()), tolerance=1e-8)
    assert np.max(np.abs(record.at(BEAM_POSITIONS))) < least.peak * (1 + 1e-3)
    assert least.peak < least.uncontrolled
