"""Positions along the beam, both sides of them, and extremes between them."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.model.along_beam import (
    left_of,
    positions_along,
    refined,
    sections,
    special_positions,
)

GENERAL = jb.Case(
    jb.Beam(
        20.0,
        mass_per_length=1e3,
        segments=[
            jb.Segment(7.77, flexural_rigidity=2e9),
            jb.Segment(12.23, flexural_rigidity=3e9),
        ],
        hinges=[jb.Hinge(4.321)],
    ),
    supports=[jb.Support(3.333), jb.Support(11.111, stiffness=1e8)],
    actuators=[jb.PointForce(6.789)],
    sensors=[jb.Sensor(9.876)],
    loads=[
        jb.VaryingForce(force=1e3, position=13.579),
        jb.MovingForce(force=1e3, speed=9.0, deceleration=2.7),  # stops at 15 m
        jb.MovingForce(force=1e3, speed=9.0),
        jb.VaryingForce(force=1e3, position=1.0, entry_time=1e3),
    ],
)
SPECIAL = [0.0, 1.0, 3.333, 4.321, 6.789, 7.77, 9.876, 11.111, 13.579, 15.0, 20.0]


def test_special_positions():
    found = np.unique(special_positions(GENERAL))
    assert_allclose(found, SPECIAL, rtol=1e-12, atol=1e-12)
    along = positions_along(GENERAL)
    assert along.size == 101 + len(SPECIAL) - 3 - 1  # 0, 15, 20 and 1 m are on the grid
    assert np.all(np.diff(along) > 1e-9)
    assert not len(np.setdiff1d(np.round(SPECIAL, 9), np.round(along, 9)))
    patch = jb.Patch(0.2, 0.45, 1e-3)
    case = jb.Case(jb.Beam(1.0, 2.0, 1.0), actuators=[patch])
    assert_allclose(np.unique(special_positions(case)), [0.0, 0.2, 0.45, 1.0])


def test_sides():
    x = np.array([0.0, 2.0, 3.333, 10.0, 20.0])
    for quantity, left in (("deflection", []), ("moment", [0, 2, 4]), ("shear", range(5))):
        found = sections(GENERAL, x, quantity)
        assert_array_equal(found.left_of, list(left))
        values = np.concatenate([np.zeros(5), -1.0 - np.arange(len(left))])
        expected = np.zeros(5)
        expected[list(left)] = -1.0 - np.arange(len(left))
        assert_array_equal(found.smallest(values), expected)
        assert_array_equal(found.largest(values), np.zeros(5))
    assert_allclose(sections(GENERAL, x, "moment").points[5:], [0.0, 3.333, 20.0], atol=3e-6)


@pytest.mark.parametrize("place", [3.14159, 0.05, 19.99])
@pytest.mark.parametrize(
    "shape", [lambda d: -(d**2), lambda d: -np.abs(d), lambda d: np.where(d > 0, -d, 3 * d)]
)
def test_extremes_between_positions(place, shape):
    """A smooth peak, a kink, and a steep one, of size 1 at a place; the other extreme at an end."""

    def evaluate(x):
        return {"value": 1.0 + shape(x - place)}

    def curves(found):
        values = np.stack([found["value"], -found["value"]], -1)
        return values, np.abs(values).max(), [np.zeros((values.shape[0], 0))] * 2

    x, found = refined(dataclasses.replace(GENERAL, loads=[]), evaluate, curves)
    assert np.all(np.diff(x) > 0)
    assert_allclose(found["value"], 1.0 + shape(x - place))
    assert_allclose(found["value"].max(), 1.0, rtol=1e-4)
    assert x.size < 250


def test_peaks_of_sensors_on_both_sides_of_a_support():
    """Those of a shear force in continuous time, against its samples at the passages of the force.

    A sensor nearer to the support than `left_of` has its jump within a step, and peaks 12 % beyond.
    """
    beam = jb.Beam(20.0, 6e9, 1e4, modes=4, damping_ratio=0.02)
    case = jb.Case(beam, supports=[jb.Support(11.3)], loads=[jb.MovingForce(force=2e5, speed=25.0)])
    places = [float(left_of(case, 11.3)), 11.3]
    run = jb.Run(1.0, sample_rate=100.0)
    case = dataclasses.replace(case, sensors=[jb.Sensor(x, "shear") for x in places], run=run)
    passage = 11.3 / 25.0
    times = np.union1d(np.linspace(0.0, 1.0, 2001), passage + np.array([-1e-7, 1e-7]))
    record = jb.simulate(case, times)
    extremes = jb.simulate(case).extremes
    swept = jb.sweep(case, {"loads.0.speed": np.array([25.0, 26.0])})
    for i, side in enumerate(("left", "right")):
        history = np.asarray(record.shear_force(11.3, side))
        assert_allclose(extremes.smallest[i], history.min(), atol=10.0)  # N, of 200 kN
        assert_allclose(extremes.largest[i], history.max(), atol=10.0)
        assert_allclose(swept.peak_shear[0, i], np.abs(history).max(), rtol=1e-4)
