"""Trajectories of loads: kinematics against their cubics, splines against scipy."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from scipy.interpolate import CubicSpline

from jaxbeam.case.trajectory import BrakingTrajectory, TabulatedTrajectory
from jaxbeam.model.load_set import LoadSet, WheelSet

LENGTH = jnp.asarray(2.0)
TIMES = np.array([0.0, 0.3, 0.7, 0.8, 1.5])
POSITIONS = np.array([-0.2, 0.4, 0.9, 0.7, 2.1])  # the load turns round twice


def kinematics_of_cubics(trajectory, times):
    """Position, speed and acceleration from the cubics of a trajectory."""
    breakpoints, cubics = (np.asarray(part) for part in trajectory.cubics())
    piece = np.clip(np.searchsorted(breakpoints, times, side="right") - 1, 0, None)
    curves = [np.polynomial.Polynomial(cubics[i]) for i in piece]
    elapsed = times - breakpoints[piece]
    return np.array(
        [[curve.deriv(d)(t) for curve, t in zip(curves, elapsed, strict=True)] for d in range(3)]
    )


def assert_cubics_agree(trajectory, times):
    expected = trajectory.kinematics(jnp.asarray(times))
    assert_allclose(kinematics_of_cubics(trajectory, times), expected, atol=1e-12)


@given(
    speed=st.floats(0.2, 20.0),
    direction=st.sampled_from([-1.0, 1.0]),
    entry=st.floats(-1.0, 3.0),
    braking=st.floats(-5.0, 50.0),
)
def test_cubics_of_a_braking_trajectory(speed, direction, entry, braking):
    """Loads that stop on the beam, that cross it, and that accelerate."""
    numbers = (jnp.asarray(x) for x in (direction * speed, entry, braking))
    trajectory = BrakingTrajectory(*numbers, LENGTH)
    exit_time = float(trajectory.entry_exit_times()[1])
    times = entry + np.linspace(0.0, min(exit_time - entry, 5.0), 23)[1:-1]
    assert_cubics_agree(trajectory, times)


@pytest.mark.parametrize("points", [2, 3, 5])
def test_cubics_of_a_table_are_those_of_a_spline(points):
    breakpoints, positions = TIMES[:points], POSITIONS[:points]
    trajectory = TabulatedTrajectory(jnp.asarray(breakpoints), jnp.asarray(positions), LENGTH)
    times = np.linspace(breakpoints[0], breakpoints[-1], 40)[1:-1]
    assert_cubics_agree(trajectory, times)
    spline = CubicSpline(breakpoints, positions)  # not-a-knot; of few points a parabola or a line
    expected = [spline(times, d) for d in range(3)]
    assert_allclose(kinematics_of_cubics(trajectory, times), expected, atol=1e-11)
    assert_cubics_agree(trajectory, np.array([breakpoints[-1] + 0.5]))  # where the load stays


def test_cubics_of_a_load_set_are_padded_to_the_same_number():
    trajectories = (
        BrakingTrajectory(jnp.asarray(1.0), jnp.asarray(0.2), jnp.asarray(0.5), LENGTH),
        TabulatedTrajectory(jnp.asarray(TIMES), jnp.asarray(POSITIONS), LENGTH),
    )
    zeros = jnp.zeros((2, 1))
    breakpoints, cubics = LoadSet(trajectories, WheelSet(zeros, zeros)).cubics()
    assert breakpoints.shape == (2, 5) and cubics.shape == (2, 5, 4)
    assert_allclose(breakpoints[0], [0.2, 2.2, np.inf, np.inf, np.inf])
    assert_allclose(cubics[1], trajectories[1].cubics()[1])
    assert LoadSet((), WheelSet(zeros[:0], zeros[:0])).cubics()[1].shape == (0, 1, 4)
