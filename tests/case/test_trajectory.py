"""Paths of loads: as functions of time, and as cubic pieces."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from scipy.interpolate import CubicSpline

from jaxbeam.case.trajectory import BrakingTrajectory, TabulatedTrajectory
from jaxbeam.model.contact import LoadSet

LENGTH = jnp.asarray(2.0)
KNOTS = np.array([0.0, 0.3, 0.7, 0.8, 1.5])
PLACES = np.array([-0.2, 0.4, 0.9, 0.7, 2.1])  # it turns round on the way


def pieced(motion, times):
    """Position, speed and acceleration by the pieces of a motion."""
    since, cubics = (np.asarray(part) for part in motion.pieces())
    piece = np.clip(np.searchsorted(since, times, side="right") - 1, 0, None)
    curves = [np.polynomial.Polynomial(cubics[i]) for i in piece]
    gone = times - since[piece]
    rows = [[curve.deriv(d)(t) for curve, t in zip(curves, gone, strict=True)] for d in range(3)]
    return np.array(rows)


def agree(motion, times):
    assert_allclose(pieced(motion, times), motion.travel(jnp.asarray(times)), atol=1e-12)


@given(
    speed=st.floats(0.2, 20.0),
    way=st.sampled_from([-1.0, 1.0]),
    entry=st.floats(-1.0, 3.0),
    braking=st.floats(-5.0, 50.0),
)
def test_pieces_of_braking_loads_are_their_path(speed, way, entry, braking):
    """To a halt on the beam, over it, or ever faster."""
    numbers = (jnp.asarray(x) for x in (way * speed, entry, braking))
    motion = BrakingTrajectory(*numbers, LENGTH)
    leaves = float(motion.entry_exit_times()[1])
    agree(motion, entry + np.linspace(0.0, min(leaves - entry, 5.0), 23)[1:-1])


@pytest.mark.parametrize("points", [2, 3, 5])
def test_pieces_of_tables_are_splines(points):
    knots, places = KNOTS[:points], PLACES[:points]
    motion = TabulatedTrajectory(jnp.asarray(knots), jnp.asarray(places), LENGTH)
    times = np.linspace(knots[0], knots[-1], 40)[1:-1]
    agree(motion, times)
    spline = CubicSpline(knots, places)  # not-a-knot, with few points a parabola or a line
    assert_allclose(pieced(motion, times), [spline(times, d) for d in range(3)], atol=1e-11)
    agree(motion, np.array([knots[-1] + 0.5]))  # where it stays


def test_loads_of_different_kinds_have_equally_many_pieces():
    motions = (
        BrakingTrajectory(jnp.asarray(1.0), jnp.asarray(0.2), jnp.asarray(0.5), LENGTH),
        TabulatedTrajectory(jnp.asarray(KNOTS), jnp.asarray(PLACES), LENGTH),
    )
    nothing = jnp.zeros((2, 1))
    since, cubics = LoadSet(motions, nothing, nothing).cubics()
    assert since.shape == (2, 5) and cubics.shape == (2, 5, 4)
    assert_allclose(since[0], [0.2, 2.2, np.inf, np.inf, np.inf])
    assert_allclose(cubics[1], motions[1].cubics()[1])
    assert LoadSet((), nothing[:0], nothing[:0]).cubics()[1].shape == (0, 1, 4)
