"""Contact forces at instants: fewer or more loads than modes, beside dense systems of each run."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.model import contact
from jaxbeam.model.contact import _pressing_forces, contact_at
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model


@pytest.mark.parametrize(("loads", "modes"), [(1, 3), (3, 3), (7, 3), (40, 5)])
@pytest.mark.parametrize("compile", [lambda function: function, jax.jit])
def test_pressing_forces_obey_the_contact_law(loads, modes, compile):
    """Of masses from nothing to a hundred times the modal mass; none off the beam."""
    random = np.random.default_rng(loads)
    shape = random.normal(size=(4, loads, modes))
    mass = 10.0 ** random.uniform(-3, 2, size=(4, loads, 2))
    mass[:, ::3] = 0.0
    free = random.normal(size=(4, loads, 2))
    found = compile(_pressing_forces)(shape, mass, free)
    for instant in range(4):
        for run in range(2):
            coupling = mass[instant, :, run, None] * (shape[instant] @ shape[instant].T)
            expected = np.linalg.solve(np.eye(loads) + coupling, free[instant, :, run])
            assert_allclose(found[instant, :, run], expected, rtol=1e-9, atol=1e-11)


def test_instants_in_blocks_are_those_all_at_once(monkeypatch):
    """Of a mass, a force and a vehicle on springs, with commands of a shaker."""
    case = jb.Case(
        jb.Beam(20.0, 3e9, 8000.0, modes=4),
        sensors=[jb.Sensor(10.0)],
        actuators=[jb.Shaker(8.0)],
        loads=[
            jb.MovingMass(mass=2000.0, speed=20.0),
            jb.MovingForce(force=1e4, speed=25.0, entry_time=0.2),
            jb.QuarterCar(14e3, 1100.0, 9e5, 3e4, 3e6, 8e3, speed=15.0),
        ],
        run=jb.Run(1.0, sample_rate=200.0),
    )
    model, loads = modal_model(case), load_set(case)
    random = np.random.default_rng(0)
    times = np.linspace(0, 1.2, 101)
    states = random.normal(size=(101, model.state_count + loads.vehicle_states, 1))
    commands = random.normal(size=(101, model.command_matrix.shape[1], 1))
    whole = contact_at(model, loads, times, states, commands)
    monkeypatch.setattr(contact, "KNOWN_BLOCK", 7 * loads.wheel_count)
    in_blocks = contact_at(model, loads, times, states, commands)
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(in_blocks), strict=True):
        assert one.shape == other.shape
        assert_allclose(other, one, rtol=1e-13, atol=1e-13)
