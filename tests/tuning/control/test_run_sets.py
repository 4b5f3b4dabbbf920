"""Sets of runs: those without control in groups that fit into memory."""

import numpy as np
from numpy.testing import assert_allclose

import jaxbeam as jb
from tuning.control import run_set

BEAM = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2)
CASE = jb.Case(
    BEAM,
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.2, speed=2.0)],
    run=jb.Run(0.4, sample_rate=200.0),
)


def test_runs_in_groups_have_the_same_histories(monkeypatch):
    cases = [jb.replace(CASE, {"loads.0.mass": mass}) for mass in (0.1, 0.2, 0.3)]
    wanted = np.arange(80) / 200.0, np.array([0.2, 0.3]), ()
    expected = run_set._uncontrolled_histories(cases, *wanted)
    plan = run_set._integration_plan(cases)
    run_bytes = 8.0 * run_set.STATE_COPIES * 80 * plan.substeps * 4
    monkeypatch.setattr(run_set, "block_memory", lambda: 2.5 * run_bytes)
    assert run_set.runs_at_once(cases[0], wanted[0], plan) == 2
    assert run_set.runs_at_once(cases[0], np.arange(1e5), plan) == 1
    monkeypatch.setattr(run_set, "MAX_KNOWN_RUNS", 0)
    found = run_set._uncontrolled_histories(cases, *wanted)
    assert found.deflection.shape == expected.deflection.shape == (3, 80, 2)
    assert_allclose(found.deflection, expected.deflection, atol=1e-12)
