"""Quantities with units, in case files, in Python and on the command line; SI inside."""

import dataclasses
import inspect
import re
import subprocess
import sys

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.case import part_classes, unit_at
from jaxbeam.case.fields import kinds
from jaxbeam.case.reading.units import in_si, is_quantity
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
    ("3 apples", "m", "must be in m; '3 apples' has no unit that is known"),
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
