"""Crossings against the closed form of a moving force and integrations by scipy.

Random crossings against the modal equations, integrated by scipy: deflections and stated errors.

Masses to a hundred times the beam's and speeds to ten times the critical one; one to eight modes;
loads that enter together, follow, meet or stop on the beam.
"""

import dataclasses
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.model.statics import static_peak
from jaxbeam.simulation.simulate import ContactLossWarning
from tests.differences import assert_close, plan_of
from tests.fuzzing import examples
from tests.oracles import modal_equations
from tests.oracles.closed_forms import (
    critical_speed,
    moving_force,
)
from tests.oracles.crossing import GRAVITY, Load
from tests.simulation.pinned_span import SENSORS, SPAN, case_of


@pytest.fixture(scope="module")
def one_force():
    """Function that simulates a force of 3 N on the undamped span for two crossing times."""
    case = case_of(UNDAMPED, [Load(3.0 / GRAVITY, 1.0, kind="force")])
    plan = plan_of(case)

    def run(speed):
        times = np.linspace(0.0, 2 * SPAN.length / speed, 101)
        return jb.simulate(jb.replace(case, {"loads.0.speed": speed}), jnp.asarray(times), plan)

    return run


UNDAMPED = dataclasses.replace(SPAN, damping_ratio=0.0)


@pytest.mark.filterwarnings(
    # the model is bilateral, the oracles too
    "ignore::jaxbeam.simulation.simulate.ContactLossWarning"
)
@pytest.mark.parametrize("ratio", [0.05, 0.3, 1.0, 1.0 + 1e-9, 2.0, 3.7])
def test_moving_force_has_its_closed_form_at_every_speed(one_force, ratio):
    record = one_force(ratio * critical_speed(UNDAMPED))
    q, u = moving_force(UNDAMPED, 3.0, ratio * critical_speed(UNDAMPED), np.asarray(record.times))
    assert_close(record.deflection, q @ UNDAMPED.shapes(np.array(SENSORS)).T, 1e-10)
    assert_close(record.velocity, u @ UNDAMPED.shapes(np.array(SENSORS)).T, 1e-10)


LENGTH, RIGIDITY, MASS_PER_LENGTH = 2.0, 50.0, 1.5
CRITICAL_SPEED = np.pi / LENGTH * np.sqrt(RIGIDITY / MASS_PER_LENGTH)  # of the first mode, m/s
PERIOD = 2 * LENGTH / CRITICAL_SPEED  # of the first mode, s
ROUNDING = 1e-9  # of the largest deflection; scipy is no more accurate


def logarithmic(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(np.log10(low), np.log10(high)).map(lambda exponent: 10.0**exponent)


@st.composite
def travelling(draw) -> Load:
    """A load that crosses, or brakes to a stop on the beam."""
    speed = draw(logarithmic(0.05, 10.0)) * CRITICAL_SPEED * draw(st.sampled_from([1, -1]))
    stop = draw(st.sampled_from([None, None, None, 0.3, 0.5, 0.9]))  # share of the beam
    return Load(
        mass=draw(logarithmic(1e-3, 100.0)) * MASS_PER_LENGTH * LENGTH,
        speed=speed,
        entry_time=draw(st.sampled_from([0.0, 0.0, 0.1, 0.7])) * PERIOD,
        deceleration=0.0 if stop is None else speed**2 / (2 * stop * LENGTH),
        kind=draw(st.sampled_from(["mass", "mass", "force"])),
    )


@st.composite
def crossings(draw) -> tuple[modal_equations.Span, list[Load], float]:
    """Span, loads and duration (s)."""
    damping = draw(st.sampled_from([0.0, 0.01, 0.1]))
    span = modal_equations.Span(LENGTH, RIGIDITY, MASS_PER_LENGTH, draw(st.integers(1, 8)), damping)
    loads = draw(st.lists(travelling(), min_size=1, max_size=3))
    ends = [min(load.time_at(LENGTH), load.stop_time) for load in loads]
    return span, loads, max(ends) + draw(st.sampled_from([0.1, 2.0])) * PERIOD


def crossing_case(span, loads, duration) -> jb.Case:
    """The same crossing in jaxbeam."""
    kinds = {"mass": jb.MovingMass, "force": jb.MovingForce}
    return jb.Case(
        jb.Beam(
            LENGTH, RIGIDITY, MASS_PER_LENGTH, damping_ratio=span.damping_ratio, modes=span.modes
        ),
        sensors=[jb.Sensor(0.37 * LENGTH), jb.Sensor(0.5 * LENGTH)],
        loads=[
            kinds[load.kind](
                mass=load.mass,
                speed=load.speed,
                entry_time=load.entry_time,
                deceleration=load.deceleration,
            )
            for load in loads
        ],
        run=jb.Run(duration, sample_rate=60.0 / duration),
    )


@settings(max_examples=examples(8))
@given(crossings())
def test_deflections_agree_with_scipy_within_the_stated_error(crossing):
    span, loads, duration = crossing
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        record = jb.simulate(crossing_case(span, loads, duration))
    positions = np.array([0.37, 0.5]) * LENGTH
    expected = modal_equations.respond(span, loads, positions, np.asarray(record.times)).deflection
    size = np.abs(expected).max()
    stated = float(record.error_estimate)
    assert np.isfinite(stated) and stated <= 1e-6
    assert_allclose(record.deflection, expected, rtol=0, atol=max(stated, ROUNDING) * size)


# Runs with very heavy and very fast masses, and with very many modes.


def test_slow_load_on_two_hundred_modes_is_near_statics():
    """The peak is at most that of a load applied suddenly, twice the static one."""
    case = jb.Case(
        jb.Beam(6.0, 1168.0, 5.35, damping_ratio=0.05, modes=200),
        sensors=[jb.Sensor(3.0)],
        loads=[jb.MovingMass(mass=0.5, times=[0.0, 0.2], positions=[2.99, 3.01])],
        run=jb.Run(0.2, sample_rate=100.0),
    )
    record = jb.simulate(case)
    assert np.isfinite(np.asarray(record.deflection)).all()
    assert record.peak_deflection[0] < 2.001 * static_peak(case, np.array([3.0]))[0]
