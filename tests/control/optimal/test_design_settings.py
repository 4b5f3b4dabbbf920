"""Settings of the design of regulators: weighted deflections, design model, after the crossing.

Gains are compared by the poles of the loop, with those of explicit plants and scipy's gains.
"""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from numpy.testing import assert_allclose
from scipy.linalg import solve_continuous_are

import jaxbeam as jb
from jaxbeam.analysis.stability import frozen_poles, stability_limit
from jaxbeam.control.design_model import DesignModel
from tests.analysis import test_stability as oracle
from tests.analysis.test_stability import LENGTH, MASS, SPEED, shaker_case, state_matrices

STATES = [1000.0, 100.0, 10.0, 0.1, 0.01, 0.01, 0.0]
TIMES = np.array([0.2, 0.4]) / SPEED


def sines(x):
    return np.sin(np.arange(1, 4) * np.pi * x / LENGTH)


def gain(A, B, Q=None, R=9e-5):
    """Gain of the time-invariant regulator of a plant, by scipy."""
    Q = np.diag(STATES) if Q is None else Q
    return B.T @ scipy.linalg.solve_continuous_are(A, B, Q, [[R]]) / R


def assert_poles(case, times, matrices, rtol=1e-7):
    """Check that the poles at some times (s) are the eigenvalues of the matrices."""
    found = frozen_poles(case, np.asarray(times)).poles
    for poles, matrix in zip(found, matrices, strict=True):
        expected = np.sort_complex(np.linalg.eigvals(matrix))
        assert_allclose(np.sort_complex(poles), expected, rtol=rtol)


def test_weighted_deflections():
    """Eq. (3.2) of the thesis, y'Qy with the deflections y at some positions."""
    positions, weights = [0.15, 0.4], [2e5, 7e5]
    law = jb.LQR(STATES, [9e-5], positions=positions, position_weight=weights, coordinates="sine")
    rows = np.zeros((2, 7))
    rows[:, :3] = [sines(x) for x in positions]
    A, B = state_matrices(0.0, 0.0, 0.0, 4.6)
    K = gain(A, B, np.diag(STATES) + rows.T @ np.diag(weights) @ rows)
    assert np.max(np.abs(K / gain(A, B) - 1)) > 0.5  # the weights matter
    loops = [state_matrices(SPEED * t, SPEED, MASS, 4.6)[0] - B @ K for t in TIMES]
    assert_poles(shaker_case(law), TIMES, loops)


def test_design_without_suspension(monkeypatch):
    law = jb.LQR(STATES, [9e-5], coordinates="sine", design=DesignModel(stiffness=0.0, damping=0.0))
    case, plants = shaker_case(law), [state_matrices(SPEED * t, SPEED, MASS, 4.6) for t in TIMES]
    monkeypatch.setattr(oracle, "SPRING", 0.0)
    monkeypatch.setattr(oracle, "DAMPER", 0.0)
    K = gain(*state_matrices(0.0, 0.0, 0.0, 4.6))
    assert_poles(case, TIMES, [A - B @ K for A, B in plants])


def test_design_with_another_mass_and_speed():
    """The gain is that for the position of the load, with mass and speed of the design."""
    law = jb.LQR(
        STATES,
        [9e-5],
        coordinates="sine",
        points=300,
        design=DesignModel(mass=0.3, speed=0.8),
        horizon="frozen",
    )
    loops = []
    for x in SPEED * TIMES:
        A, B = state_matrices(x, SPEED, MASS, 4.6)
        loops.append(A - B @ gain(*state_matrices(x, 0.8, 0.3, 4.6)))
    assert_poles(shaker_case(law), TIMES, loops, rtol=1e-5)


def test_time_invariant_regulator_after_the_crossing():
    law = jb.LQR(
        STATES, [9e-5], coordinates="sine", points=100, after="time-invariant", horizon="frozen"
    )
    A, B = state_matrices(0.0, 0.0, 0.0, 4.6)
    assert_poles(shaker_case(law), [1.2], [A - B @ gain(A, B)])  # the load leaves at 1.09 s
    without_regulator = jb.LQR(STATES, [9e-5], coordinates="sine", points=100, horizon="frozen")
    assert_poles(shaker_case(without_regulator), [1.2], [A])


def test_stability_limit_in_mass():
    """A mass at rest at 0.2 m, the deflection at 0.25 m fed back to the shaker at 0.5 m."""
    at_rest = [jb.MovingMass(mass=0.01, times=[0.0, 9.0], positions=[0.2, 0.2])]
    feedback = 3100.0
    case = shaker_case(jb.Feedback([feedback]), loads=at_rest)

    def largest(mass):
        A, B = state_matrices(0.2, 0.0, mass, 4.6)
        row = np.concatenate([sines(0.25), np.zeros(4)])
        return np.linalg.eigvals(A - feedback * B @ row[None]).real.max()

    assert largest(0.01) < 0 < largest(0.1)
    expected = scipy.optimize.brentq(largest, 0.01, 0.1, rtol=1e-9)
    measure = lambda case: frozen_poles(case, np.zeros(1)).largest_real_part[0]  # noqa: E731
    found = stability_limit(case, "loads.0.mass", 0.01, 0.1, measure, points=3)
    assert found == pytest.approx(expected, rel=1e-5)


# A table of default size, designed in a process with two threads: it must end.

SHARE = 0.4375  # of the crossing
TIME_LIMIT = 240  # s, of which an idle machine needs ten
LOOP_STATES, LOOP_COMMANDS = [1e6] * 3 + [10.0] * 3, [1e-3]
DESIGN = """
import json
import equinox as eqx
import jaxbeam as jb
from tests.control.optimal.test_design_settings import SHARE, loop
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
        controller=jb.LQR(LOOP_STATES, LOOP_COMMANDS, horizon="frozen"),
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
    P = solve_continuous_are(A, B, np.diag(LOOP_STATES), np.diag(LOOP_COMMANDS))
    expected = B.T @ P / LOOP_COMMANDS[0]
    assert_allclose(
        json.loads(found.stdout), expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max()
    )
