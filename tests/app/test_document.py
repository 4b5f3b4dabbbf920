"""Changes of the text of a case: what is not changed stays as it was."""

import tomllib
from importlib import resources

import hypothesis
import pytest
from hypothesis import strategies as st

import jaxbeam as jb
from jaxbeam.app.workspace import changed
from tests.app.conftest import RIG
from tests.modules import ROOT

CASES = sorted(
    [*ROOT.glob("examples/*/case.toml"), *ROOT.glob("jaxbeam/rigs/*.toml")]
    + [*ROOT.glob("jaxbeam/files/starters/*.toml")]
)


CASE = jb.api.load_case(RIG)


def case_of(text):
    return jb.api.load_case(text)


@pytest.mark.parametrize("path", CASES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_text_without_changes_is_the_same_to_the_byte(path):
    text = path.read_text(encoding="utf-8")
    assert changed(text, []) == text


@pytest.mark.parametrize("path", CASES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_only_the_line_of_the_number_changes(path):
    text = path.read_text(encoding="utf-8")
    case = jb.load_case(path)
    length = float(case.beam.length)
    new = changed(text, [{"set": "beam.length", "to": 1.25 * length}], case).splitlines()
    different = [i for i, (a, b) in enumerate(zip(text.splitlines(), new, strict=True)) if a != b]
    assert len(different) == 1
    comment = text.splitlines()[different[0]].partition("#")[2]
    assert new[different[0]].partition("#")[2] == comment
    value = jb.api.load_case("\n".join(new), folder=path.parent).beam.length
    assert float(value) == pytest.approx(1.25 * length, rel=1e-12)


def test_a_quantity_keeps_its_unit():
    new = changed(RIG, [{"set": "loads.0.speed", "to": 2.0}], case_of(RIG))
    assert 'speed = "7.2 km/h"' in new
    assert float(case_of(new).loads[0].speed) == pytest.approx(2.0, rel=1e-12)


@hypothesis.given(st.floats(1e-3, 1e3))
def test_a_quantity_is_the_number_that_was_asked_for(speed):
    new = changed(RIG, [{"set": "loads.0.speed", "to": speed}], CASE)
    quantity = tomllib.loads(new)["loads"][0]["speed"]
    assert quantity.endswith(" km/h")
    assert float(quantity.split()[0]) / 3.6 == pytest.approx(speed, rel=1e-11)


def test_entries_are_added_and_removed():
    new = changed(
        RIG,
        [
            {"set": "sensors.1", "to": {"position": 0.9, "quantity": "moment"}},
            {"set": "actuators.0", "to": {"kind": "point", "position": 0.3, "limits": [-1.0, 1.0]}},
            {"set": "controller", "to": {"kind": "feedback", "gains": [1.0]}},
            {"set": "beam.segments.0", "to": {"length": 0.5}},
            {"remove": "supports.0"},
            {"remove": "sensors.0.name"},
        ],
    )
    content = tomllib.loads(new)
    assert content["sensors"] == [{"position": 0.3}, {"position": 0.9, "quantity": "moment"}]
    assert content["actuators"][0]["kind"] == "point" and "supports" not in content
    assert content["controller"]["gains"] == [1.0]
    assert content["beam"]["segments"] == [{"length": 0.5}]
    assert "# A rig of two spans" in new and "# kg/m" in new
    assert case_of(changed(new, [{"remove": "beam.segments"}])).controller is not None


def test_all_entries_removed_leave_no_empty_list():
    assert "actuators" not in changed(
        changed(RIG, [{"set": "actuators.0", "to": {"kind": "point", "position": 0.3}}]),
        [{"remove": "actuators.0"}],
    )


@pytest.mark.parametrize(
    "change",
    [
        {"set": "sensors.5", "to": {"position": 0.1}},
        {"set": "sensors.x", "to": 1.0},
        {"set": "beam.length.0", "to": 1.0},
        {"remove": "beam.nothing"},
        {"remove": "loads.3"},
        {"remove": "nowhere.0.position"},
    ],
)
def test_a_place_that_is_not_there_is_named(change):
    address = change.get("set") or change["remove"]
    with pytest.raises(ValueError, match=address):
        changed(RIG, [change])


def test_text_that_is_not_toml_is_refused():
    with pytest.raises(ValueError, match="not valid TOML"):
        changed("[beam", [])


def test_starters_are_read_as_text():
    folder = resources.files("jaxbeam") / "files" / "starters"
    for one in folder.iterdir():
        assert case_of(one.read_text(encoding="utf-8")).title
