"""Steps of many states, by their contact forces, beside those by one matrix a step."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.integrator import step_matrices

CASE = jb.Case(
    jb.Beam(1.2, 11.68, 0.535, 0.02, modes=5),
    sensors=[jb.Sensor(0.45)],
    loads=[
        jb.MovingMass(mass=0.3, speed=6.0),
        jb.MovingForce(mass=0.2, speed=-5.0, entry_time=0.01),
    ],
    run=jb.Run(0.2, sample_rate=100.0),
)
CASES = {
    "one block a mode": CASE,
    "coupled modes": jb.Case(
        CASE.beam,
        supports=[jb.Support(0.7, stiffness=500.0, damping=20.0)],
        sensors=CASE.sensors,
        loads=CASE.loads,
        run=CASE.run,
    ),
    "without inertia": jb.Case(CASE.beam, sensors=CASE.sensors, loads=CASE.loads[1:], run=CASE.run),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_both_ways_give_the_same_run(name, monkeypatch):
    by_matrices = jb.simulate(CASES[name])
    monkeypatch.setattr(step_matrices, "MANY_STATES", 0)
    by_forces = jb.simulate(CASES[name])
    assert by_forces.steps == by_matrices.steps
    for field in ("coordinates", "contact_force", "peak_deflection", "lowest_contact_force"):
        found, expected = getattr(by_forces, field), getattr(by_matrices, field)
        assert_allclose(found, expected, rtol=1e-9, atol=1e-11 * np.abs(expected).max())


def test_many_modes_take_no_matrix_of_all_states(monkeypatch):
    """Chunks of steps are as long as their largest matrices, of rows and states, allow."""
    lengths, chunk_length = [], step_matrices.chunk_length

    def recorded(*arguments):
        lengths.append(chunk_length(*arguments))
        return lengths[-1]

    monkeypatch.setattr("jaxbeam.integrator.integrate.chunk_length", recorded)
    case = jb.replace(CASES["without inertia"], {"run.duration": 0.001, "run.sample_rate": 1e6})
    jb.simulate(jb.Case(jb.Beam(1.2, 11.68, 0.535, modes=80), loads=case.loads, run=case.run))
    monkeypatch.setattr(step_matrices, "MANY_STATES", 10**9)
    jb.simulate(jb.Case(jb.Beam(1.2, 11.68, 0.535, modes=80), loads=case.loads, run=case.run))
    assert max(lengths) > 5 * min(lengths)
