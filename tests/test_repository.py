"""CONTRIBUTING: its paths and commands exist, and its picture shows the present imports."""

import ast
import collections
import html
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import threadpoolctl

import jaxbeam as jb
from docs.draw_rooms import PICTURE, listing, package_imports
from tests.layers.selection import layers, matches
from tests.layers.touched import nearest_tests
from tests.modules import ROOT, module_files, parse
from tests.mutants.__main__ import first_fit, left_ones, patterns, targets
from tests.test_imports import package

TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
SPANS = re.findall(r"`([^`]+)`", TEXT)
IMAGES = re.findall(r"!\[[^]]*\]\(([^)]+)\)", TEXT)
PATHS = sorted({span for span in SPANS if re.fullmatch(r"[.\w<>*/-]+(/|\.\w+)", span)} | {*IMAGES})
LINES = [span for span in SPANS if span.startswith((".venv/bin/", "bash ", "python3 "))]
COMMANDS = [shlex.split(part) for line in LINES for part in line.split("&&")]


@pytest.mark.parametrize("path", PATHS)
def test_paths_exist(path):
    """A <name> in a path stands for any file there."""
    assert list(ROOT.glob(re.sub(r"<\w+>", "*", path))), f"CONTRIBUTING names {path}"


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_commands_exist(command):
    """Programs are declared or made by the first command, files exist, the tests are collected."""
    program, *arguments = command
    if command[:3] == ["python3", "-m", "venv"] or program == ".venv/bin/pip":
        return
    if program == "bash":
        script, *words = arguments
        assert all(word in (ROOT / script).read_text() for word in words)
        return
    assert program == ".venv/bin/uv"
    if arguments == ["sync"]:
        return
    group = "dev"
    if arguments[1] == "--group":
        group = arguments.pop(2)
        arguments.pop(1)
    run, tool, *options = arguments
    assert run == "run"
    tool = {"sphinx-build": "sphinx"}.get(tool, tool)
    if tool == "python":
        flag, module, *_ = options
        path = ROOT / module.replace(".", "/")
        files = path.with_suffix(".py"), path / "__main__.py"
        assert flag == "-m" and any(file.exists() for file in files)
        return
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())
    declared = (
        groups["dependency-groups"][group] + groups["project"]["optional-dependencies"]["test"]
    )
    assert any(re.match(rf"{tool}\b", requirement) for requirement in declared)
    assert all(Path(ROOT / word).exists() for word in options if "/" in word and word != "out/site")


def test_pytest_accepts_its_options():
    """All at once; without files, for one that imports no library and is collected at once."""
    commands = [command[3:] for command in COMMANDS if command[1:3] == ["run", "pytest"]]
    options = [word for words in commands for word in words if not word.startswith("tests/")]
    assert len(options) > 2
    line = [
        sys.executable,
        "-m",
        "pytest",
        *options,
        "--collect-only",
        "tests/test_repository.py",
    ]
    ended = subprocess.run(line, cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_the_picture_shows_the_present_imports():
    text = html.unescape(PICTURE.read_text(encoding="utf-8"))
    assert listing(package_imports()) in text, "run: .venv/bin/uv run python -m docs.draw_rooms"


# Metadata agree: versions, dates, and names for those who cite and contribute.

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_citation_has_the_version_and_date_of_the_changelog():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    version = PROJECT["version"]
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    released = re.search(rf"^## {re.escape(version)} \((\d{{4}}-\d\d-\d\d)\)", changelog, re.M)
    assert f"\nversion: {version}\n" in citation
    assert released and f'date-released: "{released[1]}"' in citation


def test_classifiers_are_of_the_python_versions_that_are_allowed():
    least = int(PROJECT["requires-python"].removeprefix(">=3."))
    named = [int(one.split("3.")[1]) for one in PROJECT["classifiers"] if "Python :: 3." in one]
    assert named == list(range(least, max(named) + 1))
    assert PROJECT["classifiers"] == sorted(PROJECT["classifiers"])


@pytest.mark.parametrize("name", ["AGENTS.md", "llms.txt", "CODE_OF_CONDUCT.md"])
def test_files_and_names_that_are_named_exist(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    paths = set(re.findall(r"\]\(([\w./-]+)\)", text))
    paths |= {one for one in re.findall(r"[`\s]([\w./]+\.(?:md|py|pyi))\b", text)}
    paths |= {one for one in re.findall(r"`([.\w/]+/)`", text)}
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []
    assert len(text.split()) < 400
    for function in re.findall(r"\bjb\.(\w+)", text):
        assert hasattr(jb, function)


def test_the_lines_for_assistants_run():
    lines = re.findall(r"^    (.*)$", (ROOT / "llms.txt").read_text(encoding="utf-8"), re.M)
    found: dict = {}
    exec("\n".join(lines[:-1]), found)  # all but the sweep
    assert found["record"].peak_deflection[0] > 0
    assert jb.check(found["case"]).warnings == ()


# Names: no class name stands for two things.


def test_no_class_name_is_used_twice():
    modules_by_class = collections.defaultdict(list)
    for module, path in module_files().items():
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.ClassDef):
                modules_by_class[node.name].append(module)
    assert {name: modules for name, modules in modules_by_class.items() if len(modules) > 1} == {}


# Layers of the tests: names in the lists are those of tests.

NIGHTLY, _ = layers()


def test_nightly_tests_exist():
    """With any parameters."""
    for test in NIGHTLY:
        file, _, function = test.partition("[")[0].partition("::")
        source = (ROOT / file).read_text(encoding="utf-8")
        assert re.search(rf"^def {function}\(", source, re.MULTILINE), test


def test_a_test_is_named_with_or_without_its_parameters():
    names = frozenset({"a.py::test_one[x-1]", "b.py::test_two", "c.py"})
    assert matches("a.py::test_one[x-1]", names) and not matches("a.py::test_one[x-2]", names)
    assert matches("b.py::test_two[y]", names) and matches("c.py::test_three", names)
    assert not matches("b.py::test_two_more", names)


def test_the_nearest_tests_of_a_module():
    assert nearest_tests(["jaxbeam/model/modes.py"]) == ["tests/model/test_modes.py"]
    assert nearest_tests(["tests/test_repository.py", "tests/test_gone.py"]) == [
        "tests/test_repository.py"
    ]
    assert nearest_tests(["tests/layers/selection.py"]) == ["tests/test_repository.py"]
    assert nearest_tests(["docs/conf.py"]) == []


def test_all_modules_have_tests_near():
    """But for `jaxbeam/__init__.py` and `__main__.py`, which many tests use."""
    for path in module_files().values():
        file = path.relative_to(ROOT).as_posix()
        near = nearest_tests([file])
        assert near or file in ("jaxbeam/__init__.py", "jaxbeam/__main__.py"), file
        assert all((ROOT / test).exists() for test in near)


def test_matrices_are_computed_by_one_thread():
    """In one process and in many, whatever loaded NumPy first."""
    import scipy.linalg  # noqa: F401

    libraries = threadpoolctl.threadpool_info()
    assert {one["num_threads"] for one in libraries if one["user_api"] == "blas"} == {1}


# Data of the test of the tests: tests that should notice changes, and what may go unnoticed.


def test_targets_name_files_and_tests_that_exist():
    """Each pattern is the first that fits some file, each file of the packages has a pattern."""
    no_numbers, tests = patterns()
    files = [path.relative_to(ROOT).as_posix() for path in (ROOT / "jaxbeam").rglob("*.py")]
    fits = {name: first_fit(name) for name in files}
    assert {*no_numbers, *tests} == {*fits.values()} - {None}
    rooms = {name: package(name.removesuffix(".py").replace("/", ".")) for name in files}
    mutated = {rooms[name] for name in targets()}
    words = "model case control.estimation analysis simulation simulation.integrator"
    assert mutated == {f"jaxbeam.{word}" for word in [*words.split(), "simulation.sweeps"]}
    assert not [n for n in files if fits[n] is None and rooms[n] in mutated]
    for test in sorted({test for own in tests.values() for test in own}):
        path, _, name = test.partition("::")
        assert (ROOT / path).exists(), test
        assert not name or re.search(rf"^def {name}\(", (ROOT / path).read_text(), re.M), test


def test_mutants_that_may_survive_are_of_lines_that_exist():
    for entry in left_ones():
        assert entry["before"] != entry["after"] and len(entry["why"]) > 20
