"""CONTRIBUTING: its paths and commands exist, and its picture shows the present imports."""

import html
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from docs.draw_rooms import PICTURE, listing, package_imports
from tests.modules import ROOT

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
        "tests/test_layers.py",
    ]
    ended = subprocess.run(line, cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_the_picture_shows_the_present_imports():
    text = html.unescape(PICTURE.read_text(encoding="utf-8"))
    assert listing(package_imports()) in text, "run: .venv/bin/uv run python -m docs.draw_rooms"
