"""Tolerances that double precision cannot reach end in a sentence, after little work."""

import re

import numpy as np
import pytest

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


@pytest.mark.parametrize("tolerance", [0.0, -1e-7, 1e-15, 1.0, np.nan, np.inf])
def test_tolerances_that_are_no_share_are_refused_before_any_work(tolerance):
    invalid = jb.Case(CASE.beam)  # has no loads: not looked at
    with pytest.raises(ValueError, match="tolerance must be at least 1e-14 and below 1"):
        jb.simulate(invalid, tolerance=tolerance)
    with pytest.raises(ValueError, match="tolerance must be at least 1e-14 and below 1"):
        jb.sweep(CASE, {"loads.0.mass": [0.1]}, tolerance=tolerance, progress=False)
