"""The types of the packages, as the checkers of a user's program find them."""

import json
import os
import subprocess
import sys

import pytest

from tests.modules import DATA, PACKAGES, ROOT

CONSUMER = (DATA / "consumer.py").read_text(encoding="utf-8")
WRONG = {
    "record.deflexion": "attribute",
    "jb.simulat(case)": "attribute",
    "jb.simulate(3.0)": "argument",
    "tuning.read_log(3.0)": "argument",
    "fit.verdict + 1": "operand",
    "jb.Beam(lenght=1.0)": "argument",
}


def mypy(folder) -> dict[int, str]:
    """Complaints of mypy about `consumer.py` of a folder, by lines."""
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--output=json", "consumer.py"],
        cwd=folder,
        env=os.environ | {"MYPYPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    found = map(json.loads, done.stdout.splitlines())
    return {one["line"]: one["message"] for one in found}


def pyright(folder) -> dict[int, str]:
    """Complaints of pyright about `consumer.py` of a folder, by lines."""
    (folder / "pyrightconfig.json").write_text(json.dumps({"extraPaths": [str(ROOT)]}))
    done = subprocess.run(
        [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    found = json.loads(done.stdout)["generalDiagnostics"]
    return {one["range"]["start"]["line"] + 1: one["message"] for one in found}


@pytest.mark.parametrize("checker", [mypy, pyright])
def test_a_typed_program_is_accepted_and_its_faults_are_found(tmp_path, checker):
    """One run: lines that are right have no complaint, those of `WRONG` have one each."""
    pytest.importorskip(checker.__name__, reason="a checker of types, in the group dev")
    (tmp_path / "consumer.py").write_text(CONSUMER + "\n".join(WRONG) + "\n")
    first = len(CONSUMER.splitlines()) + 1
    complaints = checker(tmp_path)
    assert sorted(complaints) == list(range(first, first + len(WRONG))), complaints
    for message, word in zip(complaints.values(), WRONG.values(), strict=True):
        assert word in message.lower() or checker is pyright


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_say_that_they_are_typed(package):
    assert (ROOT / package / "py.typed").exists()
