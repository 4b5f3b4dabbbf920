"""Without JAX: NumPy alone reads, checks and simulates, to the same bits; the rest is named."""

import json
import os
import subprocess
import sys

import pytest

from tests.cli.page.conftest import RIG
from tests.modules import ROOT
from tests.runtime.known_runs import cases, main

ABSENT = """
import importlib.abc, importlib.util, sys
GONE = ("jax", "jaxlib", "equinox", "optax", "optimistix")
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: (
    None if name.split(".")[0] in GONE else found(name, package)
)


class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split(".")[0] in GONE and name not in sys.modules:
            raise ModuleNotFoundError(f"no {name}")


sys.meta_path.insert(0, Absent())
"""
QUICK = ["footbridge", "laboratory_rig", "linear_guide", "railway_bridge"]


def without_jax(code):
    """What a program prints where JAX is not installed."""
    line = [sys.executable, "-c", ABSENT + code]
    known = os.environ | {"PYTHONPATH": str(ROOT)}
    ended = subprocess.run(line, cwd=ROOT, env=known, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.mark.parametrize("names", [QUICK, sorted(set(cases()) - set(QUICK))], ids=["quick", "rest"])
def test_runs_are_the_same_to_the_last_bit(names):
    code = (
        f"import json\nfrom tests.runtime.known_runs import main\nprint(json.dumps(main({names})))"
    )
    assert json.loads(without_jax(code)) == main(names)


def test_the_page_is_answered_and_what_is_missing_is_named(tmp_path):
    case = tmp_path / "rig.toml"
    case.write_text(RIG, encoding="utf-8")
    questions = {
        "hello": {},
        "schema": {},
        "model": {},
        "run": {},
        "change": {"changes": [{"set": "loads.0.speed", "to": 2.0}]},
        "preview": {"values": {"loads.0.speed": 1.1}, "ranges": {"loads.0.speed": [0.5, 2.0]}},
        "envelopes": {},
        "take": {"what": "csv"},
        "vehicles": {},
        "words": {},
    }
    code = f"""
import json
from pathlib import Path
from jaxbeam.cli.page.questions import Page

text = Path({str(case)!r}).read_text()
page = Page(Path({str(tmp_path / "cases")!r}))
for name, question in {questions!r}.items():
    answered, body, kind, file = page.ask(name, json.dumps(question | {{"text": text}}))
    print(name, answered, len(body) > 100)
import jaxbeam as jb
try:
    jb.sweep(jb.api.load_case(text), {{"loads.0.speed": [1.0, 2.0]}}, progress=False)
except ImportError as error:
    print(error)
try:
    import jax
    jax.grad(lambda x: x)(1.0)
except ImportError as error:
    print(error)
"""
    lines = without_jax(code).splitlines()
    assert lines[:-2] == [f"{name} True True" for name in questions]
    assert all(line.endswith("pip install jax equinox optax") for line in lines[-2:])
