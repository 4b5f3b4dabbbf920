"""Cases and parts as text: numbers with units."""

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.case import address_words, value_words
from jaxbeam.case.display import unit_scale, with_prefix

BEAM = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02)


def test_parts_show_numbers_with_units():
    assert repr(BEAM) == (
        "Beam(length=0.6 m, flexural_rigidity=11.68 N m^2, mass_per_length=0.535 kg/m,"
        " damping_ratio=0.02)"
    )
    assert repr(jb.Support(0.2, stiffness=5e3)) == "Support(position=0.2 m, stiffness=5000 N/m)"
    lqr = jb.StateFeedback(gain=np.arange(8.0).reshape(1, 8))
    assert "gain=[0, 1, 2, ... 1 x 8 values]" in repr(lqr)


def test_a_case_has_a_line_for_each_part_with_its_address():
    loads = [jb.MovingForce(force=1e3 * i, speed=2.0) for i in range(50)]
    lines = repr(jb.Case(BEAM, loads=loads, sensors=[jb.Sensor(0.3)], title="a row")).split("\n  ")
    assert lines[0] == "Case 'a row'" and lines[1] == f"beam: {BEAM!r}"
    assert "loads.2: MovingForce(force=2000 N, speed=2 m/s)" in lines
    assert "... 46 more loads ..." in lines
    assert lines[-2] == "loads.49: MovingForce(force=49000 N, speed=2 m/s)"


def test_a_case_in_a_notebook():
    """The same parts as in its text, in a table; texts are escaped."""
    loads = [jb.MovingForce(force=1e3 * i, speed=2.0) for i in range(50)]
    shown = jb.Case(BEAM, loads=loads, title="a < b")._repr_html_()
    assert "<b>a &lt; b</b>" in shown and "a < b" not in shown
    assert ">Beam</td>" in shown and ">length = 0.6 m, flexural_rigidity = 11.68 N m^2," in shown
    assert shown.count(">MovingForce</td>") == 4 and "... 46 more loads ..." in shown


def test_traced_numbers_show_their_shapes():
    texts = []

    @jax.jit
    def length(case):
        texts.append(repr(case))
        return case.beam.length

    length(jb.Case(BEAM))
    assert "length=traced float64[]" in texts[0]


def test_a_changed_number_is_shown():
    changed = eqx.tree_at(lambda beam: beam.damping_ratio, BEAM, np.zeros(3))
    assert "damping_ratio" not in repr(changed)  # the default, for each mode
    changed = eqx.tree_at(lambda beam: beam.damping_ratio, BEAM, np.array([0.0, 0.01, 0.02]))
    assert "damping_ratio=[0, 0.01, 0.02]" in repr(changed)


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        (-2.5e-3, "m", "-2.5 mm"),
        (2e5, "N", "200 kN"),
        (3e10, "Pa", "30 GPa"),
        (4000.0, "kg", "4000 kg"),
        (2e-3, "m^3", "0.002 m³"),
        (1.5e-4, "1", "0.00015"),
        (1.5e-4, "1/m", "0.00015 1/m"),
        (float("nan"), "m", "nan m"),
    ],
)
def test_prefixes_of_single_numbers(value, unit, expected):
    assert with_prefix(value, unit) == expected


def test_units_without_prefix_stay():
    assert unit_scale([2e-7], "m^4") == (1.0, "m^4")
    assert unit_scale([2e6], "kg/m") == (1.0, "kg/m")


CASE = jb.Case(
    BEAM,
    supports=[jb.Support(0.2)],
    sensors=[jb.Sensor(0.3, name="midspan"), jb.Sensor(0.4)],
    loads=[jb.MovingMass(mass=1.0, speed=2.0), jb.Axles(train="HSLM-A1", speed=2.0)],
    controller=jb.Feedback(gains=[1.0, 2.0], period=0.01),
)


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("loads.0.speed", "speed of load 0"),
        ("loads.*.speed", "speed of all loads"),
        ("loads.1.speed", "speed of train 1"),
        ("loads.1.train", "train of train 1"),
        ("supports.0.rotational_stiffness", "rotational stiffness of the support"),
        ("sensors.0.position", "position of sensor midspan"),
        ("sensors.1.position", "position of sensor 1"),
        ("beam.youngs_modulus", "Young's modulus of the beam"),
        ("controller.gains.1", "gains 1 of the controller"),
        ("run.duration", "duration"),
    ],
)
def test_addresses_in_words(address, words):
    assert address_words(CASE, address) == words


def test_values_in_words():
    assert value_words(CASE, "loads.0.speed", 2.0) == "speed of load 0: 2 m/s"
    assert value_words(CASE, "beam.damping_ratio", 0.01) == "damping ratio of the beam: 0.01"
    assert value_words(CASE, "loads.1.train", "HSLM-A2") == "train of train 1: HSLM-A2"
