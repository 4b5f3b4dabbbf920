"""What regulators are designed for: weights of outputs, beliefs, the time after the crossing.

Gains show in the poles of the loop; those expected come from `written_out` plants and scipy.
"""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.stability import frozen_poles
from jaxbeam.analysis.stability_limits import stability_limit
from jaxbeam.control.design_model import DesignModel
from tests.analysis import test_stability as oracle
from tests.analysis.test_stability import LENGTH, MASS, SPEED, rig, written_out

STATES = [1000.0, 100.0, 10.0, 0.1, 0.01, 0.01, 0.0]
TIMES = np.array([0.2, 0.4]) / SPEED


def sines(x):
    return np.sin(np.arange(1, 4) * np.pi * x / LENGTH)


def gain(A, B, Q=None, R=9e-5):
    """The time-invariant regulator of a plant, by scipy."""
    Q = np.diag(STATES) if Q is None else Q
    return B.T @ scipy.linalg.solve_continuous_are(A, B, Q, [[R]]) / R


def assert_poles(case, times, matrices, rtol=1e-7):
    """The poles at some times (s) are those of closed loops with the matrices."""
    found = frozen_poles(case, np.asarray(times)).poles
    for poles, matrix in zip(found, matrices, strict=True):
        expected = np.sort_complex(np.linalg.eigvals(matrix))
        assert_allclose(np.sort_complex(poles), expected, rtol=rtol)


def test_weights_of_deflections_add_to_those_of_states():
    """Eq. (3.2) of the thesis, y'Qy with y the deflections at some places."""
    places, weights = [0.15, 0.4], [2e5, 7e5]
    law = jb.LQR(STATES, [9e-5], places=places, place_weight=weights, coordinates="sine")
    rows = np.zeros((2, 7))
    rows[:, :3] = [sines(x) for x in places]
    A, B = written_out(0.0, 0.0, 0.0, 4.6)
    K = gain(A, B, np.diag(STATES) + rows.T @ np.diag(weights) @ rows)
    assert np.max(np.abs(K / gain(A, B) - 1)) > 0.5  # the weights tell
    loops = [written_out(SPEED * t, SPEED, MASS, 4.6)[0] - B @ K for t in TIMES]
    assert_poles(rig(law), TIMES, loops)


def test_a_suspension_may_be_left_out_of_the_design(monkeypatch):
    law = jb.LQR(STATES, [9e-5], coordinates="sine", design=DesignModel(stiffness=0.0, damping=0.0))
    case, real = rig(law), [written_out(SPEED * t, SPEED, MASS, 4.6) for t in TIMES]
    monkeypatch.setattr(oracle, "SPRING", 0.0)
    monkeypatch.setattr(oracle, "DAMPER", 0.0)
    K = gain(*written_out(0.0, 0.0, 0.0, 4.6))
    assert_poles(case, TIMES, [A - B @ K for A, B in real])


def test_beliefs_in_mass_and_speed_shape_the_table():
    """The gain is that for the place of the load, as the load believed in passes it."""
    believed = 0.3, 0.8
    law = jb.StepLQR(
        STATES, [9e-5], coordinates="sine", points=300, design=DesignModel(mass=0.3, speed=0.8)
    )
    loops = []
    for x in SPEED * TIMES:
        A, B = written_out(x, SPEED, MASS, 4.6)
        loops.append(A - B @ gain(*written_out(x, believed[1], believed[0], 4.6)))
    assert_poles(rig(law), TIMES, loops, rtol=1e-5)


def test_after_the_crossing_the_time_invariant_regulator_may_take_over():
    law = jb.StepLQR(STATES, [9e-5], coordinates="sine", points=100, after="time-invariant")
    A, B = written_out(0.0, 0.0, 0.0, 4.6)
    assert_poles(rig(law), [1.2], [A - B @ gain(A, B)])  # the load leaves at 1.09 s
    none = jb.StepLQR(STATES, [9e-5], coordinates="sine", points=100)
    assert_poles(rig(none), [1.2], [A])


def test_the_margin_in_mass_is_where_a_pole_crosses():
    """A mass parked at 0.2 m, the deflection at 0.25 m fed back to the shaker at 0.5 m."""
    parked = [jb.MovingMass(mass=0.01, times=[0.0, 9.0], positions=[0.2, 0.2])]
    feedback = 3100.0
    case = rig(jb.Feedback([feedback]), loads=parked)

    def largest(mass):
        A, B = written_out(0.2, 0.0, mass, 4.6)
        row = np.concatenate([sines(0.25), np.zeros(4)])
        return np.linalg.eigvals(A - feedback * B @ row[None]).real.max()

    assert largest(0.01) < 0 < largest(0.1)
    expected = scipy.optimize.brentq(largest, 0.01, 0.1, rtol=1e-9)
    found = stability_limit(case, "loads.0.mass", 0.01, 0.1, points=3)
    assert found == pytest.approx(expected, rel=1e-5)
