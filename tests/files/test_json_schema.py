"""JSON Schema of case files: it accepts what is a case, and refuses what is none."""

import dataclasses
import tomllib

import pytest

from jaxbeam.files.case_file import case_to_dict
from jaxbeam.files.json_schema import json_schema
from tests.modules import ROOT
from tests.strategies.examples import CONTROLLED, LOADS, PROFILES

CASES = sorted([*ROOT.glob("examples/*/case.toml"), *ROOT.glob("jaxbeam/**/rigs/*.toml")])
SCHEMA = json_schema()


def errors(content):
    """Messages of jsonschema, which nbmake needs as well."""
    jsonschema = pytest.importorskip("jsonschema")
    return [error.message for error in jsonschema.Draft202012Validator(SCHEMA).iter_errors(content)]


@pytest.mark.parametrize("path", CASES, ids=lambda path: str(path.relative_to(ROOT)))
def test_cases_are_accepted(path):
    assert errors(tomllib.loads(path.read_text(encoding="utf-8"))) == []


PARTS = {name: {"loads": (load,)} for name, load in LOADS.items()}
PARTS |= {name: {"profile": profile} for name, profile in PROFILES.items()}


@pytest.mark.parametrize("name", PARTS)
def test_saved_loads_and_profiles_are_accepted(name):
    assert errors(case_to_dict(dataclasses.replace(CONTROLLED["feedback"], **PARTS[name]))) == []


def test_both_words_of_a_key_are_accepted():
    for word in ("class", "road_class"):
        assert errors({"beam": {"length": 1.0}, "profile": {"kind": "iso8608", word: "A"}}) == []


@pytest.mark.parametrize(
    "change",
    [
        {"beam": {"length": -1.0}},
        {"beam": {"lenght": 1.0}},
        {"loads": [{"kind": "balloon"}]},
        {"loads": [{"kind": "mass", "mass": [1.0]}]},
        {"unknown": {}},
        {"profile": {"kind": "iso8608"}},
    ],
)
def test_mistakes_are_refused(change):
    assert errors({"beam": {"length": 1.0}}) == []
    assert errors({"beam": {"length": 1.0}} | change)
