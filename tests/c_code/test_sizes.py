"""Programs in C of laws with other numbers of readings and actuators than the cases have."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.c_code import export_c
from jaxbeam.case.fields import axis_names
from tests.c_code.cases import CASES, PERIOD
from tests.c_code.test_c_code import COMPILER, ROUNDING
from tests.c_code.test_missing_readings import largest_error

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
MORE_SENSORS = [jb.Sensor(0.3, "velocity"), jb.Sensor(0.1)]
MORE_ACTUATORS = [jb.PointForce(0.3), jb.PointForce(0.45)]
SIZES = [
    ("feedback", 2, 1),
    ("output-feedback", 1, 3),
    ("lqr-inversion", 1, 1),
    ("lqr-inversion", 2, 3),
    ("dlqr-kalman", 1, 3),
    ("mpc", 2, 2),  # unstable by itself: only the loop is stable
    ("gpc", 1, 3),
    ("gpc-adaptive", 1, 1),
    ("gpc-adaptive", 1, 2),
    ("gpc-adaptive", 3, 1),
    ("h-infinity", 1, 2),
]


def resized(case: jb.Case, sensors: int, actuators: int) -> jb.Case:
    """The case with fewer or more sensors and actuators, and the first entries of its settings."""
    own = (*case.sensors, *MORE_SENSORS)[:sensors], (*case.actuators, *MORE_ACTUATORS)[:actuators]
    states = 2 * case.beam.modes + sum(a.attachment().state_matrix.shape[0] for a in own[1])
    sizes = {"actuator": actuators, "sensor": sensors, "output": sensors, "state": states}
    changes = {}
    for field in dataclasses.fields(case.controller):
        value = getattr(case.controller, field.name)
        if "unit" not in field.metadata or value is None or not np.ndim(value):
            continue
        for axis, name in enumerate(axis_names(field).split()):
            count = sizes.get(name.lstrip("*"), np.shape(value)[axis])
            value = np.take(value, np.arange(count) % np.shape(value)[axis], axis)
        changes[field.name] = value
    controller = dataclasses.replace(case.controller, **changes)
    return dataclasses.replace(case, sensors=own[0], actuators=own[1], controller=controller)


@pytest.mark.parametrize(("kind", "sensors", "actuators"), SIZES)
def test_other_numbers_of_readings_and_actuators(kind, sensors, actuators, tmp_path):
    program = export_c(resized(CASES[kind], sensors, actuators), "law")
    assert largest_error(program, tmp_path) < ROUNDING


def test_adaptive_law_of_one_reading_that_never_stops_to_identify(tmp_path):
    """The covariance of its coefficients becomes small against that of the start."""
    case = jb.Case(
        jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
        actuators=[jb.PointForce(0.3, limits=[-4.0, 4.0])],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.4, speed=4.0, entry_time=0.2)],
        controller=jb.AdaptiveGPC(8, 2, 1e-9, period=PERIOD),
        run=jb.Run(1.0),
    )
    assert largest_error(export_c(case, "law"), tmp_path) < ROUNDING
