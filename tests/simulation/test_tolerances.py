"""Tolerances that double precision cannot reach end in a sentence, after little work."""

import re

import numpy as np
import pytest
import scipy

import jaxbeam as jb
from jaxbeam.integrator import step_size

CASE = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=1),
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.2, speed=2.0)],
    run=jb.Run(duration=0.1, sample_rate=100.0),
)


def test_a_tolerance_below_rounding_names_one_that_is_met(monkeypatch):
    lengths, run_of_grid = [], step_size.run_of_grid

    def counted(grid, *arguments):
        lengths.append(np.max(grid.lengths))
        return run_of_grid(grid, *arguments)

    monkeypatch.setattr(step_size, "run_of_grid", counted)
    with pytest.raises(RuntimeError, match="in double precision it agrees to") as raised:
        jb.simulate(CASE, tolerance=1e-14)
    assert len(lengths) < 60
    assert min(lengths) > 1e-6  # the search had gone on to hundred million steps
    advised = float(re.search(r"a tolerance of (\S+) or more", str(raised.value))[1])
    assert 1e-14 < advised < 1e-11
    assert jb.simulate(CASE, tolerance=advised).error_estimate <= advised


def test_a_controlled_run_names_one_too():
    controlled = jb.Case(
        CASE.beam,
        sensors=CASE.sensors,
        loads=CASE.loads,
        actuators=[jb.PointForce(0.2)],
        controller=jb.Feedback(gains=[300.0], period=0.01),
        run=CASE.run,
    )
    with pytest.raises(RuntimeError, match="in double precision it agrees to"):
        jb.simulate(controlled, tolerance=1e-14)


def deflection_under_a_limited_spring(gain: float, limit: float) -> float:
    """Deflection (m) at midspan at the end of the run, by a solver that knows nothing of jaxbeam.

    One mode q of the pinned beam, w = phi(x) q with phi = sqrt(2 / (m L)) sin(pi x / L), under a
    moving mass and the force -gain w(L/2) at x = 0.2 m within limits.
    """
    length, rigidity, line_mass, mass, speed = 0.6, 11.68, 0.535, 0.2, 2.0
    wave = np.pi / length
    size = np.sqrt(2 / (line_mass * length))
    at_force, at_middle = size * np.sin(wave * 0.2), size

    def rates(t, state):
        q, rate = state
        x = wave * speed * t
        phi, slope = size * np.sin(x), size * wave * speed * np.cos(x)
        force = np.clip(-gain * at_middle * q, -limit, limit)
        load = -mass * (9.81 + 2 * slope * rate - (wave * speed) ** 2 * phi * q) * phi
        own = -(wave**4) * rigidity / line_mass * q
        return rate, (own + at_force * force + load) / (1 + mass * phi**2)

    found = scipy.integrate.solve_ivp(
        rates, (0.0, 0.1), (0.0, 0.0), "DOP853", max_step=1e-4, rtol=1e-12, atol=1e-18
    )
    return at_middle * found.y[0, -1]


def test_a_continuous_law_that_saturates_names_the_tolerance_that_is_met():
    """Its commands bend within steps, so that halved steps lessen the error slowly."""
    limited = jb.Case(
        CASE.beam,
        sensors=CASE.sensors,
        loads=CASE.loads,
        actuators=[jb.PointForce(0.2, limits=(-0.5, 0.5))],
        controller=jb.Feedback(gains=[3000.0]),
        run=CASE.run,
    )
    with pytest.raises(RuntimeError, match="as forces bend or jump within it") as raised:
        jb.simulate(limited, tolerance=1e-12)
    met = float(re.search(r"the shortest one to (\S+), as", str(raised.value))[1])
    assert 1e-12 < met < 1e-7
    record = jb.simulate(limited, tolerance=1.1 * met)
    assert np.ptp(np.abs(record.command)) == 0.5  # it saturates
    expected = deflection_under_a_limited_spring(3000.0, 0.5)
    assert abs(record.sensor_values[-1, 0] - expected) < 1e-7 * abs(record.peak_deflection[0])


@pytest.mark.parametrize("tolerance", [0.0, -1e-7, 1e-15, 1.0, np.nan, np.inf])
def test_tolerances_that_are_no_share_are_refused_before_any_work(tolerance):
    invalid = jb.Case(CASE.beam)  # has no loads: not looked at
    with pytest.raises(ValueError, match="tolerance must be at least 1e-14 and below 1"):
        jb.simulate(invalid, tolerance=tolerance)
    with pytest.raises(ValueError, match="tolerance must be at least 1e-14 and below 1"):
        jb.sweep(CASE, {"loads.0.mass": [0.1]}, tolerance=tolerance, progress=False)
