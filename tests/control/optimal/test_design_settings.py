"""Settings of the design of regulators: weighted deflections, design model, after the crossing.

Gains are compared by the poles of the loop, with those of explicit plants and scipy's gains.
"""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from numpy.testing import assert_allclose

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
