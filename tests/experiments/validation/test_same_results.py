"""Comparison of two versions: one case of it, differences that are found, and another checkout."""

import shutil
import subprocess
import sys

import numpy as np
import pytest

from experiments.validation.same_results import comparison, writing
from tests.modules import ROOT

COMMAND = [sys.executable, "-m", "experiments.validation.same_results"]
CASE = "table_of_positions"


def test_cases_of_all_kinds_exist():
    assert len(writing.cases()) >= 30
    assert set(writing.LONG) < set(writing.cases())


@pytest.mark.parametrize(
    ("first", "second", "difference"),
    [
        ([1.0, 2.0], [1.0, 2.0], 0.0),
        ([1.0, 4.0], [2.0, 4.0], 0.25),
        ([1.0, np.nan], [1.0, np.nan], 0.0),
        ([1.0, np.nan], [1.0, 2.0], np.inf),
        ([1.0, 2.0], [1.0, np.inf], np.inf),
        ([1.0], [1.0, 2.0], np.inf),
        ([0.0], [1e-300], np.inf),
    ],
)
def test_difference_is_relative_to_the_largest_number(first, second, difference):
    assert comparison.relative_difference(np.array(first), np.array(second)) == difference


def test_one_case_equals_itself_and_a_change_is_found(tmp_path, capsys):
    arrays, seconds = writing.run_case(CASE)
    assert seconds > 0 and all(name.startswith(f"{CASE}/") for name in arrays)
    for name in ("first", "second"):
        np.savez(tmp_path / name, **arrays)
    deflection = f"{CASE}/deflection"
    changed = arrays | {deflection: arrays[deflection] * (1 + 1e-9)}
    np.savez(tmp_path / "changed", **changed)
    assert comparison.compare(tmp_path / "first.npz", tmp_path / "second.npz")
    assert not comparison.compare(tmp_path / "first.npz", tmp_path / "changed.npz")
    assert (
        "deflection  <- above the tolerance\nlargest difference 1.0e-09" in capsys.readouterr().out
    )
    del changed[deflection]
    np.savez(tmp_path / "missing", **changed)
    assert not comparison.compare(tmp_path / "first.npz", tmp_path / "missing.npz")


def test_results_of_another_checkout(tmp_path):
    """A copy of the packages, in which the gravity of a run has another default."""
    checkout = tmp_path / "other"
    for package in ("jaxbeam", "tuning"):
        shutil.copytree(ROOT / package, checkout / package)
    source = checkout / "jaxbeam" / "case" / "case.py"
    text = source.read_text(encoding="utf-8")
    assert text.count("default=9.81") == 1
    source.write_text(text.replace("default=9.81", "default=9.82"), encoding="utf-8")
    write = [*COMMAND, "write", str(tmp_path / "other.npz"), "--only", CASE, "--jobs", "1"]
    subprocess.run([*write, "--checkout", str(checkout)], check=True, cwd=ROOT)
    arrays, _ = writing.run_case(CASE)
    with np.load(tmp_path / "other.npz") as other:
        name = f"{CASE}/contact_force"
        assert other.files == sorted(arrays)
        assert 1e-4 < comparison.relative_difference(arrays[name], other[name]) < 1e-2
