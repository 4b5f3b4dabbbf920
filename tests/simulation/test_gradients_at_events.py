"""Derivatives where the response has a corner: those of the side that the guide names."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.runtime.arrays import xp
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.simulate import ContactLossWarning
from tests.differences import central

EVENT = 0.1  # s, a sample
TIMES = np.array([0.0, EVENT, 0.15])
STEP = 1e-6
CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, ends="free-clamped", damping_ratio=0.02, modes=2),
    sensors=[jb.Sensor(0.05)],
    loads=[jb.MovingForce(force=3.0, speed=2.0, entry_time=EVENT)],
    run=jb.Run(0.2),
)


def derivative(function, at: float) -> float:
    return float(jax.jit(jax.jacfwd(function))(at))


def test_a_sample_at_an_entry_has_the_derivative_of_later_entries():
    """The force enters at the free end, where the velocity has a corner in its entry time."""
    plan = integration_plan(CASE, TIMES)

    def velocity(entry):
        case = jb.replace(CASE, {"loads.0.entry_time": entry})
        return jb.simulate(case, TIMES, plan).velocity[1, 0]

    at, later, earlier = (float(velocity(EVENT + side * STEP)) for side in (0.0, 1.0, -1.0))
    assert abs(at - earlier) / STEP > 1.0
    assert at == later == derivative(velocity, EVENT) == 0.0


def test_the_time_of_a_loss_has_the_derivative_of_the_crossing():
    case = jb.Case(
        jb.Beam(2.0, 50.0, 1.5, damping_ratio=0.01, modes=3),
        sensors=[jb.Sensor(1.0)],
        loads=[jb.MovingMass(mass=3.0, speed=15.0)],
        run=jb.Run(0.1, 1000.0),
    )
    plan = integration_plan(case)

    def lost(mass):
        record = jb.simulate(jb.replace(case, {"loads.0.mass": mass}), plan=plan)
        return record.contact_lost_time[0]

    with pytest.warns(ContactLossWarning):
        difference = (float(lost(3.01)) - float(lost(2.99))) / 0.02
    assert abs(difference) > 1e-4
    assert_allclose(derivative(lost, 3.0), difference, rtol=0.02)


EXIT = 0.6 / 3.0  # s
ENTRIES = EXIT, np.nextafter(EXIT, 1.0), np.nextafter(EXIT, 0.0), EXIT + 1e-14, EXIT - 1e-14
TIED = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=3),
    sensors=[jb.Sensor(0.2)],
    loads=[jb.MovingMass(mass=0.4, speed=3.0), jb.MovingMass(mass=0.3, speed=-2.5)],
    run=jb.Run(0.5, sample_rate=137.3),
)


@pytest.mark.parametrize("entry", ENTRIES)
def test_an_exit_and_an_entry_at_one_time(entry):
    """Differences cross the tie of both events, which the derivatives stand on."""
    addresses = "loads.0.speed", "loads.1.entry_time", "loads.1.mass", "beam.flexural_rigidity"
    at = np.array([3.0, entry, 0.3, 11.68])

    def outputs(shares):
        values = [value * (1 + share) for value, share in zip(at, shares, strict=True)]
        values = dict(zip(addresses, values, strict=True))
        record = jb.simulate(jb.replace(TIED, values), tolerance=1e-10)
        return 1e3 * xp.append(record.deflection[[20, 40, 60], 0], record.peak_deflection)

    found = np.stack([jax.grad(lambda s, i=i: outputs(s)[i])(np.zeros(4)) for i in range(4)])
    assert_allclose(found, central(outputs, np.zeros(4), 1e-4, 4), rtol=1e-5, atol=1e-6)
