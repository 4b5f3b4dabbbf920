"""A user's files `tuning.py` and `experiments.py` neither break jaxbeam nor are taken by it."""

import os
import subprocess
import sys

import pytest

from tests.modules import ROOT

FOREIGN = "raise SystemExit('a file of the user was run')\n"


@pytest.fixture
def folder(tmp_path):
    for name in ("tuning", "experiments"):
        (tmp_path / f"{name}.py").write_text(FOREIGN)
    return tmp_path


def run(folder, *words: str) -> subprocess.CompletedProcess:
    """A process in a folder, which Python searches before the folder of jaxbeam."""
    paths = os.environ | {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=paths, capture_output=True, text=True
    )


def test_commands_take_the_packages_of_jaxbeam(folder):
    listed = run(folder, "-m", "jaxbeam", "reproduce", "--list")
    assert (listed.returncode, listed.stderr) == (0, "")
    assert "covers" in listed.stdout


def test_the_demonstration_is_that_of_jaxbeam(folder):
    done = run(folder, "-m", "jaxbeam", "demo", "--output", ".")  # refused by `experiments.demo`
    assert done.returncode == 1 and done.stdout == ""
    assert "not empty" in done.stderr and "user" not in done.stderr


def test_the_documented_import_is_not_taken_by_a_file(folder):
    """Nor does it make a second class of what `import tuning` has from then on."""
    code = (
        "from jaxbeam import tuning as first\nimport jaxbeam.tuning as second, tuning\n"
        "print(first.identify.__module__, first.Fit is second.Fit is tuning.Fit)"
    )
    done = run(folder, "-c", code)
    assert done.stdout == "tuning.fit.identify True\n", done.stderr


def test_a_foreign_module_is_named_in_one_sentence(folder):
    (folder / "tuning.py").write_text("mine = 3\n")
    code = "import tuning\ntry:\n    from jaxbeam import tuning\nexcept ImportError as e: print(e)"
    done = run(folder, "-c", code)
    assert done.stdout == (
        f"{folder}/tuning.py was imported as 'tuning', the name of a package of jaxbeam:"
        " rename it, or import jaxbeam.tuning before it\n"
    )
    assert run(folder, "-c", "import jaxbeam, tuning\nprint(tuning.mine)").stdout == "3\n"
