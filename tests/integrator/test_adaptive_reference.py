"""Collocated contact forces against the mass-matrix form, solved by scipy with adaptive steps."""

import numpy as np
import pytest

import jaxbeam as jb
from tests.adaptive_reference import simulate_adaptive

TIMES = np.linspace(0.0, 0.5, 101)
BEAM = jb.Beam(1.2, 11.68, 0.535, [0.01, 0.03, 0.02], "pinned-clamped", modes=3)
SENSORS = [jb.Sensor(0.25), jb.Sensor(0.8)]

TWO_SPANS_AND_A_STREAM = jb.Case(
    BEAM,
    supports=[jb.Support(0.55)],
    sensors=SENSORS,
    loads=[jb.MovingMass(mass=0.3, speed=3.0), jb.MovingMass(mass=0.5, speed=4.0, entry_time=0.09)],
    run=jb.Run(0.5),
)
TWO_SPANS_AND_BRAKING = jb.replace(
    TWO_SPANS_AND_A_STREAM,
    {
        "loads.0.deceleration": 6.5,  # stops after 0.69 m and stays
        "loads.1.speed": -2.0,
        "loads.1.entry_time": 0.02,
        "loads.1.deceleration": -10.0,
    },
)
DAMPED_SUPPORT = jb.Case(
    BEAM,
    supports=[jb.Support(0.55, stiffness=4e3, damping=8.0, rotational_stiffness=2.0)],
    actuators=[jb.Shaker(0.3, stiffness=0.0, damping=0.0, bandwidth=500.0)],
    sensors=SENSORS,
    loads=[jb.MovingMass(mass=0.4, speed=4.0, entry_time=0.01)],
    run=jb.Run(0.5),
)
SHAKER_SUSPENSION = jb.replace(
    DAMPED_SUPPORT,
    {
        "supports.0.damping": 0.0,
        "actuators.0.stiffness": 3500.0,
        "actuators.0.damping": 80.0,
        "loads.0.speed": 7.0,
    },
)


@pytest.mark.parametrize(
    "case", [TWO_SPANS_AND_A_STREAM, TWO_SPANS_AND_BRAKING, DAMPED_SUPPORT, SHAKER_SUSPENSION]
)
def test_both_forms_agree(case):
    record = jb.simulate(case, TIMES, tolerance=1e-10)
    reference = simulate_adaptive(case, TIMES)
    for name, tolerance in {"deflection": 1e-9, "rates": 1e-8, "contact_force": 1e-8}.items():
        expected = getattr(reference, name)
        error = np.max(np.abs(getattr(record, name) - expected)) / np.max(np.abs(expected))
        assert error < tolerance, name
