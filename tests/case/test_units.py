"""Quantities with units, in case files, in Python and on the command line; SI inside."""

import dataclasses
import inspect
import re
import subprocess
import sys

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.case import address_words, part_classes, unit_at, value_words
from jaxbeam.case.display import unit_scale, with_prefix
from jaxbeam.case.fields import kinds
from jaxbeam.case.toml_file import in_si, is_quantity
from jaxbeam.files.case_file import case_from_dict

# Exact by definition: BIPM, The International System of Units (2019), and NIST SP 811, appendix B.
SI = [
    ("25 m", "m", 25.0),
    ("25m", "m", 25.0),
    ("0.3 in", "m", 0.3 * 0.0254),
    ("30 GN m^2", "N m^2", 30e9),
    ("30 GN·m²", "N m^2", 30e9),
    ("30 GN*m**2", "N m^2", 30e9),
    ("120 km/h", "m/s", 120 / 3.6),
    ("60 mph", "m/s", 60 * 1609.344 / 3600),
    ("15 t/m", "kg/m", 15e3),
    ("1.5e3 kN/mm", "N/m", 1.5e9),
    ("-2 lbf", "N", -2 * 0.45359237 * 9.80665),
    ("3 %", "1", 0.03),
    ("2 ms", "s", 2e-3),
    ("45 deg", "rad", np.pi / 4),
    ("210 GPa", "Pa", 210e9),
    ("0.5 1/s", "1/s", 0.5),
    ("2 kHz", "Hz", 2e3),
]


@pytest.mark.parametrize(("text", "unit", "expected"), SI)
def test_quantities_in_si(text, unit, expected):
    assert in_si(text, unit, "x") == pytest.approx(expected, rel=1e-15)


WRONG = [
    ("25 kg", "m", "beam.x must be in m, or a unit of the same kind, not '25 kg'"),
    ("30 kN m", "N m^2", "must be in N m^2, or a unit of the same kind, not '30 kN m'"),
    ("3 apples", "m", "must be in m; '3 apples' has an unknown unit"),
    ("3 m", "1", "must be a plain number"),
    ("30 tons", "kg", "a ton may be metric or not"),
    ("10 rad/s", "Hz", "cycles and radians differ by 2 pi"),
    ("10 Hz", "1/s", "cycles and radians differ by 2 pi"),
    ("100 rpm", "Hz", "cycles and radians differ by 2 pi"),
    ("5 V", "unit of a command", "takes plain numbers"),
]


@pytest.mark.parametrize(("text", "unit", "message"), WRONG)
def test_wrong_units_are_refused(text, unit, message):
    with pytest.raises(ValueError) as refused:
        in_si(text, unit, "beam.x")
    assert message in str(refused.value) and text in str(refused.value)


def test_what_is_no_quantity_is_left_alone():
    for text in ("25", "25,0 m", "fast", "HSLM-A1", "3m+4m", "5 m; x", "", "m", "1e5"):
        assert not is_quantity(text)
        assert in_si(text, "m", "x") == text


TABLES = {
    "beam": {
        "length": "25 m",
        "flexural_rigidity": "30 GN m^2",
        "mass_per_length": "15 t/m",
        "rayleigh_damping": ["0.1 1/s", "2 ms"],
    },
    "sensors": [
        {"position": "1250 cm", "quantity": "acceleration", "noise": "2 mm/s^2"},
        {"position": 12.5, "quantity": "strain", "fibre_distance": "20 cm", "range": [-1, "1 %"]},
    ],
    "loads": [{"kind": "mass", "mass": "30 t", "speed": "90 km/h"}],
    "run": {"duration": "2000 ms", "sample_rate": "0.2 kHz"},
}


def test_case_files_and_python_take_the_same_quantities():
    read = case_from_dict(TABLES)
    made = jb.Case(
        jb.Beam(**TABLES["beam"]),
        sensors=[jb.Sensor(**table) for table in TABLES["sensors"]],
        loads=[jb.MovingMass(mass="30 t", speed="90 km/h")],
        run=jb.Run(**TABLES["run"]),
    )
    expected = {
        "beam.length": 25.0,
        "beam.flexural_rigidity": 30e9,
        "beam.mass_per_length": 15e3,
        "beam.rayleigh_damping.0": 0.1,
        "beam.rayleigh_damping.1": 2e-3,
        "sensors.0.position": 12.5,
        "sensors.0.noise": 2e-3,
        "sensors.1.fibre_distance": 0.2,
        "sensors.1.range.1": 0.01,
        "loads.0.mass": 30e3,
        "loads.0.speed": 25.0,
        "run.duration": 2.0,
        "run.sample_rate": 200.0,
    }
    for case in (read, made, jb.replace(read, {"beam.length": "2500 cm", "loads.*.mass": "30 t"})):
        numbers = jb.addresses(case)
        for address, value in expected.items():
            assert float(numbers[address]) == pytest.approx(value, rel=1e-15), address
    assert unit_at(read, "beam.rayleigh_damping.1") == "s"


def test_errors_have_the_address_or_the_meaning():
    tables = TABLES | {"loads": [{"kind": "mass", "mass": "300 kN", "speed": 1.0}]}
    with pytest.raises(ValueError, match=r"loads\.0\.mass must be in kg.*not '300 kN'"):
        case_from_dict(tables)
    with pytest.raises(ValueError, match="total length must be in m.*not '25 kg'"):
        jb.Beam(length="25 kg")
    with pytest.raises(ValueError, match=r"noise must be in m/s\^2"):
        jb.Sensor(position=1.0, quantity="acceleration", noise="2 mm")
    with pytest.raises(ValueError, match=r"loads\.0\.speed must be in m/s"):
        jb.replace(case_from_dict(TABLES), {"loads.0.speed": "3 m"})
    with pytest.raises(ValueError, match="beam.length must be one number, not 'long'"):
        case_from_dict(TABLES | {"beam": {"length": "long"}})


def declared_units() -> set[str]:
    """Units of all numbers of all parts of a case."""
    classes = [
        one
        for family, _ in part_classes().values()
        for one in (kinds(family).values() if inspect.isabstract(family) else [family])
    ]
    fields = [field for one in classes for field in dataclasses.fields(one)]
    units = {field.metadata["unit"] for field in fields if "unit" in field.metadata}
    return {part for unit in units for part in unit.split(", ")}


@pytest.mark.parametrize("unit", sorted(declared_units()))
def test_every_declared_unit_is_known_or_depends_on_other_entries(unit):
    if re.search("unit of|command|reading|power|\\.\\.\\.", unit) or not re.match(r"[^\W\d]", unit):
        return
    assert in_si(f"3 {unit}", unit, "x") == pytest.approx(3.0)


def test_numbers_alone_import_no_units():
    code = (
        "import sys, jaxbeam as jb\n"
        "jb.check(jb.load_case('examples/railway_bridge/case.toml'))\n"
        "assert 'pint' not in sys.modules\n"
        "jb.Beam(length='25 m')\n"
        "assert 'pint' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_sweeps_take_quantities():
    sensors = [{"position": "12.5 m"}]
    case = case_from_dict(TABLES | {"beam": {**TABLES["beam"], "modes": 1}, "sensors": sensors})
    case = jb.replace(case, {"run.duration": 4.0})
    with_units = jb.sweep(case, {"loads.0.speed": ["36 km/h", "25 m/s"]}, progress=False)
    np.testing.assert_allclose(with_units["loads.0.speed"], [10.0, 25.0], rtol=1e-15)


# Cases and parts as text: numbers with units.

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
