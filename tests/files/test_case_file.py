"""Case files: exact round trips, and error messages that name the address and the remedy."""

import re
import tomllib

import equinox as eqx
import numpy as np
import pytest
from hypothesis import given

from jaxbeam.case.actuators.base import Patch, PointForce, Shaker
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.case import Case, Run
from jaxbeam.case.loads.base import MovingForce, MovingMass
from jaxbeam.case.sensors import Sensor
from jaxbeam.files.case_file import (
    case_from_dict,
    case_to_dict,
    load_case,
    save_case,
    with_settings,
)
from tests.strategies import cases

FULL = """
title = "one-span rig, shaker, one ball"
[beam]
length = 0.6
flexural_rigidity = 11.68
mass_per_length = 0.535
damping_ratio = 0.03
ends = "pinned-pinned"
modes = 3
[[supports]]
position = 0.6
stiffness = 2.0e6
damping = 30.0
[[actuators]]
kind = "shaker"
position = 0.5
stiffness = 3500.0
damping = 80.0
force_per_volt = 4.6
bandwidth = 10000.0
limits = [-10.0, 10.0]
[[actuators]]
kind = "patch"
start = 0.2575
end = 0.3425
moment_per_volt = 8.292e-4
correction = 0.32
amplifier_gain = 200.0
limits = [-2.5, 7.5]
[[sensors]]
position = 0.25
quantity = "deflection"
[[loads]]
kind = "mass"
mass = 0.509
speed = 0.55
entry_time = 0.0
deceleration = 0.0
[[loads]]
kind = "force"
force = 3
times = [0, 1, 2]
positions = [0, 0.2, 0.6]
[run]
duration = 2.0
sample_rate = 1000.0
"""
SMALL = {"beam": {"length": 0.6, "flexural_rigidity": 11.68, "mass_per_length": 0.535}}


@pytest.fixture
def full(tmp_path):
    """A case file with every table."""
    path = tmp_path / "case.toml"
    path.write_text(FULL)
    return path


def test_case_file_equals_the_case_built_in_python(full):
    written = Case(
        Beam(0.6, 11.68, 0.535, 0.03, modes=3),
        supports=[Support(0.6, 2e6, 30.0)],
        actuators=[
            Shaker(
                position=0.5,
                stiffness=3500.0,
                damping=80.0,
                force_per_volt=4.6,
                bandwidth=1e4,
                limits=[-10, 10],
            ),
            Patch(
                start=0.2575,
                end=0.3425,
                moment_per_volt=8.292e-4,
                correction=0.32,
                amplifier_gain=200.0,
                limits=[-2.5, 7.5],
            ),
        ],
        sensors=[Sensor(0.25)],
        loads=[
            MovingMass(0.509, 0.55),
            MovingForce(force=3, times=[0, 1, 2], positions=[0, 0.2, 0.6]),
        ],
        run=Run(2.0, 1000.0),
        title="one-span rig, shaker, one ball",
    )
    assert eqx.tree_equal(load_case(full), written)


@given(cases())
def test_dictionary_round_trip_is_exact(case):
    assert eqx.tree_equal(case_from_dict(case_to_dict(case)), case)


@given(cases())
def test_file_round_trip_is_exact(tmp_path_factory, case):
    path = tmp_path_factory.mktemp("case") / "case.toml"
    save_case(case, path)
    assert eqx.tree_equal(load_case(path), case)


def test_saved_file_has_units_in_comments(tmp_path, full):
    save_case(load_case(full), tmp_path / "copy.toml")
    text = (tmp_path / "copy.toml").read_text()
    assert "flexural_rigidity = 11.68  # N m^2\n" in text
    assert "limits = [-2.5, 7.5]  # V\n" in text
    assert tomllib.loads(text)["loads"][1]["times"] == [0.0, 1.0, 2.0]


def test_existing_file_is_overwritten_only_on_request(full):
    case = load_case(full)
    before = full.read_text()
    with pytest.raises(FileExistsError, match=r"case\.toml exists already; .* overwrite"):
        save_case(case, full)
    assert full.read_text() == before
    save_case(case, full, overwrite=True)
    assert eqx.tree_equal(load_case(full), case)


class Jack(PointForce):
    """Actuator that declares no kind of its own."""


def test_part_without_a_kind_is_not_written():
    case = Case(Beam(0.6, 11.68, 0.535), actuators=[Jack(0.3)])
    with pytest.raises(ValueError, match="actuators.0 is a Jack, which has no kind"):
        case_to_dict(case)


# Text in the file above, its replacement, and a part of the error message.
REFUSED = [
    ("[beam]", "[bean]", "a case has no 'bean'; did you mean 'beam'?"),
    ("length = 0.6", "lenght = 0.6", "beam has no key 'lenght'; did you mean 'length'?"),
    ("length = 0.6", "", "beam.length is missing; give the total length in m"),
    ("length = 0.6", 'length = "0.6"', "beam.length must be one number, not '0.6'"),
    ("length = 0.6", "length = [0.6]", "beam.length must be one number, not [0.6]"),
    ("length = 0.6", "length = true", "beam.length must be one number, not True"),
    ("length = 0.6", "length = {}", "beam.length must be one number, not {}"),
    ("length = 0.6", "length = nan", "beam.length must be a finite number; it is nan"),
    ("0.03", '[0.03, "a"]', "beam.damping_ratio must be one number or a list of numbers, not"),
    ("0.03", "[0.03]", "beam.damping_ratio lists 1 value for 3 modes"),
    ('"pinned-pinned"', "3", "beam.ends must be a word in quotes, not 3"),
    ("modes = 3", "modes = 3.0", "beam.modes must be a whole number, 1 or more; it is 3.0"),
    ("[[supports]]", "[supports]", "supports must be a list of tables; write [[supports]]"),
    ("[run]", "[[run]]", "run must be one table; write [run]"),
    ("title =", "title = 3 #", "title must be text in quotes, not 3"),
    (
        'kind = "shaker"',
        "",
        "actuators.0.kind is missing; it may be electrodynamic, patch, point, shaker, spring",
    ),
    ('"shaker"', '"shakr"', "actuators.0.kind cannot be 'shakr'; did you mean 'shaker'?"),
    ('"mass"', '"car"', "loads.0.kind cannot be 'car'; it may be axles, crowd, "),
    ('"mass"', "1", "loads.0.kind cannot be 1; it may be axles, crowd, "),
    (
        "length = 0.6",
        "length = 0.6\nskew = 9.0",
        "beam has no key 'skew'; a beam has no skew, tors",
    ),
    ("speed = 0.55", "sped = 0.55", "loads.0 has no key 'sped'; did you mean 'speed'?"),
    ("[-2.5, 7.5]", "7.5", "actuators.1.limits must be a list of 2 numbers, not 7.5"),
    ("[-2.5, 7.5]", "[1, 2, 3]", "actuators.1.limits must be a list of 2 numbers, not [1, 2, 3]"),
    ("times = [0, 1, 2]", "times = 1", "loads.1.times must be a list of numbers, not 1"),
    ("times = [0, 1, 2]", "times = [[0]]", "loads.1.times must be a list of numbers, not [[0]]"),
    ('"deflection"', '"deflexion"', "sensors.0.quantity cannot be 'deflexion'; did you mean"),
    ("[run]", '[controller]\nkind = "lqg"\n[run]', "controller.kind cannot be 'lqg'"),
    ("modes = 3", "modes = 3 3", "not valid TOML: "),
]


@pytest.mark.parametrize(("old", "new", "message"), REFUSED)
def test_invalid_case_file_is_refused_with_its_address(tmp_path, old, new, message):
    path = tmp_path / "case.toml"
    assert old in FULL
    path.write_text(FULL.replace(old, new, 1))
    with pytest.raises(ValueError) as caught:
        load_case(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "value, mend",
    [
        ("0.6 m", ': put a number with a unit in quotes, "0.6 m"'),
        ("0,6  # m", ": write a decimal point, 0.6"),
        ("pinned-free", ': put a word in quotes, "pinned-free"'),
        ("[0.6", ""),
    ],
)
def test_invalid_toml_is_refused_with_its_line_and_its_mend(tmp_path, value, mend):
    path = tmp_path / "case.toml"
    path.write_text(f"[beam]\nlength = {value}\n")
    with pytest.raises(ValueError, match=f"not valid TOML: .*{re.escape(mend)}$") as caught:
        load_case(path)
    assert "line 2" in str(caught.value) or not mend


def test_unreadable_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="cannot read the case file .*none.toml: no such"):
        load_case(tmp_path / "none.toml")
    (tmp_path / "log.bin").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"log.bin: a case file is text in UTF-8"):
        load_case(tmp_path / "log.bin")
    (tmp_path / "empty.toml").write_text("")
    with pytest.raises(
        ValueError, match=r"empty.toml: a case needs a beam; write a table \[beam\]"
    ):
        load_case(tmp_path / "empty.toml")


def test_whole_numbers_become_floats():
    case = case_from_dict({"beam": {"length": 2, "flexural_rigidity": 1, "mass_per_length": 1}})
    assert case.beam.length.dtype == np.float64


def test_optional_keys_are_not_written():
    assert "stiffness" not in case_to_dict(Case(Beam(1, 1, 1), [Support(0.5)]))["supports"][0]
    assert set(case_to_dict(case_from_dict(SMALL))) == {"beam", "run"}


def test_settings_change_numbers_words_and_counts(full):
    case = load_case(full)
    settings = {
        "beam.modes": 2,
        "beam.ends": "clamped-free",
        "beam.damping_ratio": [0.01, 0.02],
        "loads.1.times.2": 3,
        "loads.0.speed": -0.3,
        "run.gravity": 9.8,
    }
    changed = with_settings(case, settings)
    assert (changed.beam.modes, changed.beam.ends) == (2, "clamped-free")
    assert changed.beam.damping_ratio.tolist() == [0.01, 0.02]
    assert changed.loads[1].times.tolist() == [0, 1, 3]
    assert changed.loads[0].speed == -0.3
    assert case.beam.modes == 3


@pytest.mark.parametrize(
    ("address", "value", "message"),
    [
        ("loads.0.sped", 1.0, "loads.0 has no key 'sped'; did you mean 'speed'?"),
        (
            "loads.2.speed",
            1.0,
            "no number at address 'loads.2.speed'; did you mean 'loads.0.speed'",
        ),
        ("loads.1.times.3", 1.0, "no number at address 'loads.1.times.3'; did you mean"),
        ("beam.length.0", 1.0, "no number at address 'beam.length.0'; did you mean 'beam.length'"),
        ("beam.length", "long", "beam.length must be one number, not 'long'"),
        ("beam.length", -1.0, "beam.length must be positive; it is -1 m"),
        ("bean.length", 1.0, "no number at address 'bean.length'; did you mean 'beam.length'?"),
        ("profile.scale", 1.0, "'profile.scale', as it has no profile: add one first"),
    ],
)
def test_invalid_settings_are_refused(full, address, value, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        with_settings(load_case(full), {address: value})
