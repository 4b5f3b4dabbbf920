"""Random whole cases of every kind: files, JSON Schema and the commands `check`, `describe`."""

import contextlib
import dataclasses
import io
import tomllib

import equinox as eqx
import pytest
from hypothesis import HealthCheck, assume, given, settings

from jaxbeam.case.case import part_classes
from jaxbeam.case.estimator import AbstractEstimator
from jaxbeam.case.validation import check_case
from jaxbeam.cli import main
from jaxbeam.files.case_file import case_from_dict, case_to_dict, load_case, save_case
from jaxbeam.files.json_schema import json_schema
from tests.fuzzing import examples
from tests.modules import ROOT
from tests.strategies import ACTUATORS
from tests.strategies.examples import (
    CONTROLLED,
    LOADS,
    PROFILES,
    kinds_of_examples,
    kinds_of_jaxbeam,
)
from tests.strategies.whole_cases import is_valid, whole_cases

SCHEMA = json_schema()
UNFILTERED = [HealthCheck.filter_too_much, HealthCheck.too_slow, HealthCheck.data_too_large]


def test_every_kind_is_drawn():
    """Whoever adds a kind adds an example of it."""
    drawn = {"loads": set(LOADS), "profile": set(PROFILES), "actuators": set(ACTUATORS)}
    drawn |= kinds_of_examples()
    families = {name: part_classes()[name].part_class for name in drawn if name != "estimator"}
    families["estimator"] = AbstractEstimator
    assert {name: kinds_of_jaxbeam(family) for name, family in families.items()} == drawn


@pytest.mark.parametrize("name", [*CONTROLLED, *LOADS, *PROFILES])
@pytest.mark.filterwarnings("ignore::UserWarning")  # of slow sampling
def test_files_keep_every_kind(name, tmp_path):
    """With words and numbers that are not the defaults; the case stays valid."""
    case = CONTROLLED.get(name, CONTROLLED["feedback"])
    part = {"loads": (LOADS[name],)} if name in LOADS else {}
    part |= {"profile": PROFILES[name]} if name in PROFILES else {}
    case = dataclasses.replace(case, **part)
    check_case(case)
    save_case(case, tmp_path / "case.toml")
    assert eqx.tree_equal(load_case(tmp_path / "case.toml"), case)
    assert eqx.tree_equal(case_from_dict(case_to_dict(case)), case)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("whole")


# A case may warn, as of slow sampling.
@pytest.mark.filterwarnings("ignore::UserWarning")
# Libraries that a case needs first while it is drawn may take random numbers as they are imported.
@pytest.mark.filterwarnings("ignore:Do not use the .random. module")
@settings(max_examples=examples(2), suppress_health_check=UNFILTERED)
@given(whole_cases())
def test_files_schema_and_commands(folder, case):
    assume(is_valid(case))
    path = folder / "case.toml"
    save_case(case, path, overwrite=True)
    assert eqx.tree_equal(load_case(path), case)
    assert eqx.tree_equal(case_from_dict(case_to_dict(case)), case)
    jsonschema = pytest.importorskip("jsonschema")
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    errors = jsonschema.Draft202012Validator(SCHEMA).iter_errors(content)
    assert [error.message for error in errors] == []
    for command in ("check", "describe"):
        printed, said = io.StringIO(), io.StringIO()
        with (
            contextlib.redirect_stdout(printed),
            contextlib.redirect_stderr(said),
            pytest.raises(SystemExit) as ended,
        ):
            main([command, str(path)])
        assert ended.value.code == 0 and printed.getvalue(), said.getvalue()
        assert all(line.startswith("jaxbeam: ") for line in said.getvalue().splitlines())


# JSON Schema of case files: it accepts what is a case, and refuses what is none.

CASES = sorted([*ROOT.glob("examples/*/case.toml"), *ROOT.glob("jaxbeam/**/rigs/*.toml")])


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
