"""Sensors where their quantity jumps: at supports, hinges, changes of section, ends of patches."""

import dataclasses
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb

SPAN, FORCE, STIFFNESS = 20.0, 300e3, 20e9


def two_spans(speed: float, sides=("left", "right"), **changes) -> jb.Case:
    """Two equal spans under a force, with shear sensors on sides of the pier."""
    case = jb.Case(
        jb.Beam(2 * SPAN, STIFFNESS, 10e3, damping_ratio=0.02, modes=8),
        supports=[jb.Support(SPAN)],
        sensors=[jb.Sensor(SPAN, "shear", side=side) for side in sides],
        loads=[jb.MovingForce(force=FORCE, speed=speed)],
        run=jb.Run(duration=2 * SPAN / speed, sample_rate=200 * speed / SPAN),
    )
    return dataclasses.replace(case, **changes)


def test_shear_beside_a_pier_under_a_slow_force():
    """Left of the pier R_1 - P <= 0 before it, M / L <= 0 behind it; right of it the mirror image.

    Of a force at a from an outer end M = P a (L^2 - a^2) / (4 L^2), at most P L / (6 sqrt(3)).
    """
    case = two_spans(0.2)
    record, swept = jb.simulate(case), jb.sweep(case, {"loads.0.speed": [0.2]})
    low, high = jb.envelope(case, x=[SPAN], quantity="shear")
    beyond = FORCE / (6 * np.sqrt(3))
    assert_allclose(record.smallest, [-FORCE, 0.0], atol=2e-3 * FORCE)
    assert_allclose(record.largest, [0.0, FORCE], atol=2e-3 * FORCE)
    assert_allclose(swept["peak_shear"][0], [FORCE, FORCE], rtol=2e-3)
    assert_allclose([low[0], high[0]], [record.smallest[0], record.largest[1]], rtol=1e-6)
    for i, side in enumerate(case.sensors):
        at_pier = record.shear_force(SPAN, side.side)
        assert_allclose(record.sensor_values[:, i], at_pier, atol=1e-9 * FORCE)
        assert_allclose(record.at(SPAN, "shear") if i else at_pier, at_pier)
        assert_allclose(jb.statics.static_peak(case, SPAN, quantity="shear", side=side.side), FORCE)
    behind = np.asarray(record.load_position)[:, 0] > SPAN + 0.1
    assert np.min(record.sensor_values[behind, 0]) == pytest.approx(-beyond, rel=1e-2)


def test_sides_of_fast_crossings_are_the_same_in_sweeps():
    case = two_spans(35.0)
    record, swept = jb.simulate(case), jb.sweep(case, {"loads.0.speed": [20.0, 35.0]})
    largest = np.maximum(-record.smallest, record.largest)
    assert abs(largest[0] / largest[1] - 1) > 1e-2
    assert_allclose(swept["peak_shear"][1], largest, rtol=1e-6)
    grid = record.envelope("shear", np.array([SPAN]))
    assert_allclose(grid.smallest, np.min(record.sensor_values), rtol=1e-6)
    assert_allclose(grid.largest, np.max(record.sensor_values), rtol=1e-6)


def test_rows_beside_a_pier_mirror_each_other():
    """Modes of two equal spans are even or odd, and their third derivatives odd or even."""
    rows = np.asarray(jb.state_space(two_spans(35.0)).unloaded.C)[:, :8]
    signs = np.where(np.arange(8) % 2, -1.0, 1.0)
    assert_allclose(rows[0], signs * rows[1], atol=1e-6 * np.max(np.abs(rows)))


def test_rotations_beside_a_hinge():
    """A force at the hinge of a Gerber beam: its cantilever bends, the rest turns rigidly."""
    length, at = 10.0, 4.0
    case = jb.Case(
        jb.Beam(length, 2e8, 1e3, modes=20, ends="clamped-pinned", hinges=[jb.Hinge(at)]),
        sensors=[jb.Sensor(at, "rotation", side=side) for side in ("left", "right")],
        loads=[jb.VaryingForce(force=1e4, position=at)],
        run=jb.Run(duration=1.0, sample_rate=2000.0),
    )
    slopes = [-1e4 * at**2 / 2 / 2e8, 1e4 * at**3 / 3 / 2e8 / (length - at)]
    record = jb.simulate(case)
    for i, (sensor, slope) in enumerate(zip(case.sensors, slopes, strict=True)):
        static = jb.statics.static_peak(case, at, quantity="rotation", side=sensor.side)
        assert static == pytest.approx(abs(slope), rel=1e-9)
        values = np.asarray(record.sensor_values)[:, i]
        assert np.sign(values[np.argmax(np.abs(values))]) == np.sign(slope)
        assert 1.5 < np.max(np.abs(values)) / abs(slope) < 2.5  # a step load


def test_curvatures_beside_a_change_of_section():
    """The moment is the same on both sides, the curvature in the ratio of the stiffnesses."""
    beam = jb.Beam(
        20.0,
        mass_per_length=1e3,
        modes=6,
        segments=[jb.Segment(8.0, flexural_rigidity=2e9), jb.Segment(12.0, flexural_rigidity=6e9)],
    )
    names = [(q, s) for q in ("curvature", "moment") for s in ("left", "right")]
    case = jb.Case(
        beam,
        sensors=[jb.Sensor(8.0, quantity, side=side) for quantity, side in names],
        loads=[jb.MovingForce(force=1e5, speed=10.0)],
        run=jb.Run(duration=2.0),
    )
    left, right, moment, same = np.asarray(jb.simulate(case).sensor_values).T
    assert_allclose(left, 3 * right, atol=1e-6 * np.max(np.abs(left)))
    assert_allclose(moment, 2e9 * left, atol=1e-6 * np.max(np.abs(moment)))
    assert_allclose(moment, same, atol=1e-6 * np.max(np.abs(moment)))


def test_a_side_without_effect_is_refused():
    case = two_spans(35.0, sensors=[jb.Sensor(SPAN, side="left")])
    with pytest.raises(ValueError, match=r"sensors\.0\.side would have no effect on .* deflection"):
        jb.simulate(case)


@pytest.mark.parametrize(
    ("quantity", "changes", "name"),
    [
        ("shear", {}, r"supports\.0"),
        ("moment", {"supports": [jb.Support(SPAN, rotational_stiffness=1e9)]}, r"supports\.0"),
        ("shear", {"supports": [], "actuators": [jb.PointForce(SPAN)]}, r"actuators\.0"),
        (
            "curvature",
            {
                "beam": jb.Beam(
                    2 * SPAN,
                    mass_per_length=10e3,
                    segments=[jb.Segment(SPAN, flexural_rigidity=f * STIFFNESS) for f in (1, 2)],
                )
            },
            "a change of section",
        ),
        (
            "rotation",
            {"beam": jb.Beam(2 * SPAN, STIFFNESS, 10e3, hinges=[jb.Hinge(SPAN)]), "supports": []},
            r"beam\.hinges\.0",
        ),
    ],
)
def test_a_side_that_is_not_named_is_told(quantity, changes, name):
    def warnings(**sensor):
        sensors = [jb.Sensor(SPAN, quantity, **sensor), jb.Sensor(SPAN / 2, quantity)]
        found = jb.check(two_spans(20.0, **changes | {"sensors": sensors})).warnings
        return [one for one in found if one.startswith("sensors")]

    sentence = rf"sensors\.0\.side: the {quantity} jumps at {name}, at 20 m"
    (told,) = warnings()
    assert re.match(sentence, told)
    assert not warnings(side="left")
    assert not warnings(side="right")
