"""Random crossings against the modal equations, integrated by scipy: deflections and stated errors.

Masses to a hundred times the beam's and speeds to ten times the critical one; one to eight modes;
loads that enter together, follow, meet or stop on the beam.
"""

import warnings

import numpy as np
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.model.statics import static_peak
from jaxbeam.simulation.simulate import ContactLossWarning
from tests.fuzzing import examples
from tests.oracles import modal_equations
from tests.oracles.crossing import Load

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


def case_of(span, loads, duration) -> jb.Case:
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
        record = jb.simulate(case_of(span, loads, duration))
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
