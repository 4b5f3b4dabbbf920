"""Random case files, logs and command lines: each is accepted or ends in one error message."""

import contextlib
import copy
import dataclasses
import datetime
import io
import tomllib
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
import tomli_w
from hypothesis import HealthCheck, assume, example, given, settings, strategies as st

from jaxbeam.case.case import Case, part_classes
from jaxbeam.case.controller import AbstractEstimator
from jaxbeam.case.loads.vehicle_parts import VehicleSensor
from jaxbeam.case.validation import check_case
from jaxbeam.cli import main
from jaxbeam.files.case_file import case_from_dict, case_to_dict, load_case, save_case
from jaxbeam.files.json_schema import json_schema
from tests.cli.example import CASE as SMALL
from tests.files.test_case_file import FULL
from tests.fuzzing import examples
from tests.modules import ROOT
from tests.strategies import (
    ACTUATORS,
    CONTROLLED,
    LOADS,
    PROFILES,
    actuators,
    kinds_of_examples,
    kinds_of_jaxbeam,
    sensors,
)
from tests.tuning.logs import test_readers as readers
from tuning import read_logs

# Random damage to files: changed trees of dictionaries and lists, and changed bytes.

HOSTILE = (
    *(float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 5e-324, 0.0, -1, 0, 3, 10**19),
    *(10**400, True, "", "nan", "1", "mass", "pinned", "\x00", "é" * 200, 10**6),
    *([], [[]], [1], [1, "a"], [[1], [1, 2]], [True], [1e308] * 4, [[[1]]], [{}], {}),
    *({"kind": "mass"}, {"kind": "lqr"}, {"kind": []}, {"cutoff": 1e300}),
    *(datetime.date(1979, 5, 27), datetime.time(7, 32)),
)
SNIPPETS = (
    *(b"\n", b"\r", b",", b";", b"\t", b'"', b"nan", b"1e999", b"-", b"[", b"\0", b"\xff"),
    *(b"\xc2\xb2", b"1_0", b"X_Value", b"Channels\n", b"***End_of_Header***\t\n", b"# "),
)


def _paths(tree: Any, parent: tuple = ()) -> list[tuple]:
    """Paths (keys and indices) of all entries in a tree of dictionaries and lists."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree)
    paths = []
    for key, value in entries:
        paths.append((*parent, key))
        if isinstance(value, dict | list):
            paths += _paths(value, (*parent, key))
    return paths


def _entry(tree: Any, path: tuple) -> Any:
    """The entry at a path."""
    for key in path:
        tree = tree[key]
    return tree


@st.composite
def trees(draw, tree: dict) -> dict:
    """A tree with up to three entries replaced, removed, renamed, swapped or scaled."""
    tree = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        paths = _paths(tree)
        if not paths:
            break
        *path, key = draw(st.sampled_from(paths))
        parent = _entry(tree, path)
        change = draw(st.sampled_from(["replace", "remove", "rename", "swap", "scale"]))
        if change == "replace":
            parent[key] = copy.deepcopy(draw(st.sampled_from(HOSTILE)))
        elif change == "remove":
            del parent[key]
        elif change == "rename" and isinstance(parent, dict):
            parent[draw(st.text("abkinx_. ", max_size=6))] = parent.pop(key)
        elif change == "swap":
            parent[key] = copy.deepcopy(_entry(tree, draw(st.sampled_from(paths))))
        elif isinstance(parent[key], float):
            parent[key] *= draw(st.sampled_from([-1.0, 1e-200, 1e200]))
    return tree


@st.composite
def contents(draw, content: bytes) -> bytes:
    """The bytes of a file with up to five changes: bits, cuts, insertions, repetitions, an end."""
    changed = bytearray(content)
    for _ in range(draw(st.integers(1, 5))):
        if not changed:
            break
        # More often near the beginning, where headers are.
        limit = draw(st.sampled_from([60, 300, len(changed)]))
        index = draw(st.integers(0, min(limit, len(changed)) - 1))
        change = draw(st.sampled_from(["flip", "cut", "fill", "snippet", "repeat", "end"]))
        if change == "flip":
            changed[index] ^= 1 << draw(st.integers(0, 7))
        elif change == "cut":
            del changed[index : index + draw(st.integers(1, 50))]
        elif change == "fill":
            changed[index:index] = draw(st.binary(min_size=1, max_size=20))
        elif change == "snippet":
            changed[index:index] = draw(st.sampled_from(SNIPPETS))
        elif change == "repeat":
            changed[index:index] = changed[index // 2 : index // 2 + 40]
        else:
            del changed[index:]
    return bytes(changed)


# Random whole cases: all loads, vehicles, profiles, actuators, controllers and estimators.

LENGTH = 0.6  # of the beam of the examples, m


@st.composite
def varied(draw, part):
    """A part whose numbers are multiplied by random factors, one for each field."""
    factors = st.sampled_from([0.0, 0.3, 0.9, 1.0, 1.0, 1.0, 1.1, 3.0])

    def scaled(leaf):
        is_number = isinstance(leaf, float) or (
            isinstance(leaf, np.ndarray | jax.Array) and np.asarray(leaf).dtype.kind == "f"
        )
        return leaf * draw(factors) if is_number else leaf

    return jax.tree.map(scaled, part)


@st.composite
def whole_cases(draw) -> Case:
    """Cases, most of them valid, with a controller of any kind, or actuators without one."""
    kind = draw(st.sampled_from([None, *CONTROLLED]))
    case = CONTROLLED[kind or "feedback"]
    if kind is None:
        case = dataclasses.replace(
            case,
            controller=None,
            actuators=tuple(draw(st.lists(actuators(LENGTH), max_size=2))),
            sensors=tuple(draw(st.lists(sensors(LENGTH), max_size=2))),
        )
    elif draw(st.booleans()):
        law = draw(varied(case.controller))
        case = eqx.tree_at(lambda c: c.controller, case, law)
    if kind is None or draw(st.booleans()):
        names = draw(st.lists(st.sampled_from(list(LOADS)), min_size=1, max_size=3))
        case = dataclasses.replace(case, loads=tuple(draw(varied(LOADS[name])) for name in names))
        if case.controller is None and "quarter-car" in names:
            sensor = VehicleSensor(load=names.index("quarter-car"))
            case = dataclasses.replace(case, vehicle_sensors=(sensor,))
    if draw(st.booleans()):
        profile = draw(varied(PROFILES[draw(st.sampled_from(list(PROFILES)))]))
        case = dataclasses.replace(case, profile=profile)
    return case


def is_valid(case: Case) -> bool:
    """Whether a case passes `check_case`, whose refusals are one sentence."""
    try:
        check_case(case)
    except ValueError as refusal:
        assert "\n" not in str(refusal) and len(str(refusal)) < 700, refusal
        return False
    return True


# A case with every table and many optional keys.
CASE = tomllib.loads(FULL) | {
    "beam": {
        "length": 0.6,
        "width": 0.1,
        "height": 0.003,
        "youngs_modulus": 6.5e10,
        "density": 2800.0,
        "damping_ratio": [0.03, 0.02],
        "ends": "pinned-clamped",
        "modes": 2,
    },
    "supports": [{"position": 0.25}, {"position": 0.4, "stiffness": 2e6, "damping": 1.0}],
    "sensors": [
        {
            "position": 0.15,
            "noise": 1e-5,
            "filter": {"cutoff": 10.0, "order": 4},
            "sampling_period": 0.01,
            "delay": 0.01,
        },
        {"position": 0.3, "quantity": "strain", "fibre_distance": 0.001},
    ],
    "controller": {"kind": "feedback", "gains": [1.0, 1.0], "period": 0.01, "delay": 0.001},
}


def assert_one_sentence(error: Exception, start: str) -> None:
    message = str(error)
    assert message.startswith(start) and "\n" not in message and len(message) < 700, message


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@settings(max_examples=examples(300))
@given(trees(CASE))
@example({"beam": CASE["beam"] | {"length": 10**400}})
def test_random_case_file_is_read_or_refused(folder, tree):
    path = folder / "case.toml"
    path.write_text(tomli_w.dumps(tree), encoding="utf-8")
    try:
        case = load_case(path)
    except ValueError as error:
        assert_one_sentence(error, f"{path}: ")
    else:
        content = case_to_dict(case)
        assert case_to_dict(case_from_dict(content)) == content


@settings(max_examples=examples(100))
@given(contents(tomli_w.dumps(CASE).encode()))
@example(b"title = " + b"[" * 100_000)
@example(b"modes = " + b"1" * 5000)
def test_damaged_case_file_is_refused(folder, content):
    path = folder / "case.toml"
    path.write_bytes(content)
    with contextlib.suppress(ValueError):
        load_case(path)


ROWS = "".join(
    f"{t:.4f};{a:.5f};{b:.5f}\n"
    for t, a, b in zip(readers.TIMES, readers.D1, readers.D2, strict=True)
)
SEGMENT = (
    "Channels;2\nDate;2020/01/01\nTime;12:00:0{}.5\nY_Unit_Label;mm;mm\nX0;0.0\nDelta_X;0.002\n"
    "***End_of_Header***;\nX_Value;d1;d2;Comment\n"
)
LVM = (
    "LabVIEW Measurement;\nSeparator;Tab\nDecimal_Separator;.\nX_Columns;One\n"
    f"***End_of_Header***;\n\n{SEGMENT.format(0)}{ROWS}{SEGMENT.format(3)}{ROWS}"
)
TEXTS = {
    "points.csv": "# a comment\ntime [s],d1 [mm],d2 [mm]\n" + ROWS.replace(";", ","),
    "commas.csv": "time (s);d1 [mm];d2 (mm)\n" + ROWS.replace(".", ","),
    "run.lvm": LVM.replace(";", "\t"),
}


@pytest.mark.filterwarnings("ignore::tuning.logs.log.LogWarning")
@pytest.mark.parametrize("name", [*TEXTS, *readers.FORMATS])
def test_damaged_log_is_read_or_refused(folder, name, capfd):
    path = folder / name
    if name in TEXTS:
        path.write_text(TEXTS[name])
    else:
        readers.FORMATS[name](path)
    read_logs(path)

    @settings(max_examples=examples(100))
    @given(contents(path.read_bytes()), st.sampled_from(["mask", "refuse"]))
    def check(content, missing):
        path.write_bytes(content)
        try:
            read_logs(path, missing=missing)
        except ValueError as error:
            assert_one_sentence(error, str(path))

    check()
    assert capfd.readouterr().err == "", "libraries print nothing"


# Wrong counts that crash the process in the reader of scipy, or keep it busy for a minute.
@pytest.mark.parametrize(("offset", "byte"), [(145, 8), (163, 0x74), (160, 0xFF)])
def test_inconsistent_matlab_file_is_refused(folder, offset, byte):
    path = folder / "run.mat"
    readers.mat(path, ("",))
    content = bytearray(path.read_bytes())
    content[offset] = byte
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"run\.mat: the file is damaged or cut off: "):
        read_logs(path)


LINES = (
    "modes case.toml",
    "simulate case.toml",
    "sweep case.toml --over loads.0.speed=1,2",
    "frf case.toml",
    "stability case.toml",
    "tune case.toml --free loads.0.speed=1:2",
    "export case.toml",
    "identify case.toml log.csv --free beam.length=1:2",
    "weigh case.toml log.csv",
    "reproduce xyz",
)
INVALID_WORDS = """
    modes bad.toml none.toml folder --set --over --free -o --json --plot --resume --paired --pair
    --from -- --points beam.length=nan beam.length=1:2 loads.0.speed=1:2:1e300 beam=3 beam.=3
    =1 loads.-1.speed=2 loads.99999999999.speed=1 run.duration=1e300 beam.modes=10000000 nan
    loads.0.speed.0=1 1e400 out.nc out.zarr folder/out.nc xyz 0.3=nan force@nan:sensors.0
    beam.flexural_rigidity=inf:inf title=[1] beam.ends=\0 loads.0.speed=1:2:nan --scheduler
"""


@settings(max_examples=examples(150))
@given(
    st.sampled_from(LINES),
    st.lists(st.sampled_from(INVALID_WORDS.split()), min_size=1, max_size=3),
    st.data(),
)
def test_invalid_command_line_ends_in_one_error_message(folder, line, words, data):
    (folder / "folder").mkdir(exist_ok=True)
    (folder / "bad.toml").write_text("[beam\n")
    (folder / "case.toml").write_text(SMALL)
    (folder / "log.csv").write_text("time [s],d1 [mm]\n0,1\n0.1,2\n")
    arguments = line.split()
    for word in words:
        arguments.insert(data.draw(st.integers(1, len(arguments))), word)
    # Makes the few valid lines invalid too, which would take long to run.
    arguments += ["--set", "beam.length=-1"]
    stderr, stdout = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stderr(stderr),
        contextlib.redirect_stdout(stdout),
        pytest.raises(SystemExit) as ended,
    ):
        main(arguments)
    assert ended.value.code in (1, 2) and stdout.getvalue() == ""
    *notes, message = stderr.getvalue().splitlines()
    assert message.startswith("jaxbeam: ") and len(message) < 700
    assert all(note.startswith("jaxbeam: ") for note in notes) and len(notes) < 2


SETTINGS = (
    *("run.duration=1e300", "run.duration=1e-300", "run.sample_rate=1e12", "beam.modes=100000"),
    *("loads.0.mass=1e300", "loads.0.speed=1e300", "loads.0.speed=1e-300", "run.gravity=1e308"),
    *("beam.flexural_rigidity=1e300", "beam.flexural_rigidity=1e-300", "beam.length=1e300"),
    *("beam.mass_per_length=1e-300", "beam.damping_ratio=1e300", "loads.0.entry_time=1e300"),
)


def test_extreme_numbers_run_or_are_refused(folder, capsys):
    """Each ends within seconds, with a result or an error message."""
    (folder / "case.toml").write_text(SMALL)
    for setting in SETTINGS:
        with contextlib.chdir(folder), pytest.raises(SystemExit) as ended:
            main(["simulate", "case.toml", "--set", setting])
        printed = capsys.readouterr()
        if ended.value.code == 0:
            assert "deflection (m)" in printed.out
        else:
            *warned, error = printed.err.splitlines()
            assert error.startswith("jaxbeam: ")
            assert all(line.startswith("jaxbeam: warning: ") for line in warned)


# Random whole cases of every kind: files, JSON Schema and the commands `check`, `describe`.

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
def whole_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("whole")


# A case may warn, as of slow sampling.
@pytest.mark.filterwarnings("ignore::UserWarning")
# Libraries that a case needs first while it is drawn may take random numbers as they are imported.
@pytest.mark.filterwarnings("ignore:Do not use the .random. module")
@settings(max_examples=examples(2), suppress_health_check=UNFILTERED)
@given(whole_cases())
def test_files_schema_and_commands(whole_folder, case):
    assume(is_valid(case))
    path = whole_folder / "case.toml"
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
