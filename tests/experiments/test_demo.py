"""The demonstration: files, intervals around the true values, and the tuned controller."""

import dataclasses
import json
import types

import numpy as np
import pytest
import xarray
from matplotlib.figure import Figure

import tuning
from experiments import demo
from tests.differences import well_compiled
from tests.tuning import small_rig

WRITTEN = {
    "demo.json", "fit.png", "fit.toml", "map.nc", "map.png", "record.nc", "tuned.png", "tuned.toml",
}  # fmt: skip


def summary_of(folder, capsys):
    """What the demonstration prints as JSON and writes to a folder."""
    demo.run(folder, json=True)
    assert {path.name for path in folder.iterdir()} == WRITTEN
    summary = json.loads(capsys.readouterr().out)
    assert summary == json.loads((folder / "demo.json").read_text())
    return summary


def test_files_and_tables(tmp_path, capsys, monkeypatch):
    """With a fit of a formula, a tuning that changes nothing, and a small sweep."""
    given = {}

    def identify(case, logs, free):
        given.update(logs=logs, free=free)
        return dataclasses.replace(small_rig.fit(), case=case)

    def tune(case, free, cases, **_):
        given.update(case=case, cases=cases)
        return types.SimpleNamespace(case=case, plot=Figure, to_dict=lambda: {"objective": 1.0})

    monkeypatch.setattr(tuning, "identify", identify)
    monkeypatch.setattr(tuning, "tune", tune)
    monkeypatch.setattr(tuning.Fit, "plot", lambda self: Figure())  # of readings of another case
    monkeypatch.setattr(demo, "SWEPT_VALUES", {n: v[::22] for n, v in demo.SWEPT_VALUES.items()})
    summary = summary_of(tmp_path / "out", capsys)
    assert list(given["free"]) == list(summary["truth"]) and len(given["logs"]) == 3
    assert given["case"].controller is demo.HAND_SET
    assert given["case"].sensors[0].position == given["case"].beam.length / 2
    assert summary["tuned"] == {"objective": 1.0} and summary["numbers"]
    with xarray.open_dataset(tmp_path / "out" / "map.nc") as results:
        assert not results.failed.any()
        assert results.peak_deflection.sizes == {**dict.fromkeys(demo.SWEPT_VALUES, 3), "sensor": 3}


def test_identification_sweep_and_tuning(tmp_path, capsys, monkeypatch):
    identify = tuning.identify

    def identify_optimised(*arguments):
        with well_compiled():
            return identify(*arguments)

    monkeypatch.setattr(tuning, "identify", identify_optimised)
    summary = summary_of(tmp_path / "out", capsys)
    numbers, truth = summary["numbers"], summary["truth"]
    assert numbers.keys() == truth.keys()
    intervals = {name: number["interval_95"] for name, number in numbers.items()}
    hits = [low <= truth[name] <= high for name, (low, high) in intervals.items()]
    assert sum(hits) >= len(hits) - 1
    runs = summary["tuned"]["runs"]["held out"]
    peaks = ("least_peak", "peak_after", "peak_before", "uncontrolled_peak")
    least, after, before, free = (np.array(runs[name]) for name in peaks)
    assert np.all(least < after) and np.all(before < free)
    # The tuned loop reduces the peaks far more than the hand-set one.
    assert np.all(free - after > 1.5 * (free - before))


def test_a_folder_that_is_not_empty_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="is not empty; choose another"):
        demo.run(tmp_path)
