"""A table of default size, designed in a process with two threads: it must end."""

import json
import os
import subprocess
import sys

import numpy as np
from numpy.testing import assert_allclose
from scipy.linalg import solve_continuous_are

import jaxbeam as jb

SHARE = 0.4375  # of the crossing
TIME_LIMIT = 240  # s, of which an idle machine needs ten
STATES, COMMANDS = [1e6] * 3 + [10.0] * 3, [1e-3]
DESIGN = """
import json
import equinox as eqx
import jaxbeam as jb
from tests.control.optimal.test_default_points import SHARE, loop
case = loop()
jb.simulate(case)
gains = eqx.filter_jit(lambda plant: case.controller.gain_table(plant)(SHARE))
print(json.dumps(gains(jb.state_space(case, "modal")).tolist()))
"""


def loop():
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=3),
        actuators=[jb.PointForce(0.25)],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.5, speed=1.0)],
        controller=jb.LQR(STATES, COMMANDS, horizon="frozen"),
        run=jb.Run(0.7),
    )


def test_a_run_with_the_default_number_of_points_ends():
    environment = os.environ | {"PJRT_NPROC": "2"}
    line = [sys.executable, "-c", DESIGN]
    found = subprocess.run(
        line, capture_output=True, text=True, env=environment, timeout=TIME_LIMIT
    )
    assert found.returncode == 0, found.stderr
    plant = jb.state_space(loop(), "modal")
    time = SHARE * 0.6
    A, B = np.asarray(plant.A(time)), np.asarray(plant.B(time))
    P = solve_continuous_are(A, B, np.diag(STATES), np.diag(COMMANDS))
    expected = B.T @ P / COMMANDS[0]
    assert_allclose(
        json.loads(found.stdout), expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max()
    )
