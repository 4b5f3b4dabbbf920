"""The demonstration: files, intervals around the true values, and the tuned controller."""

import json

import numpy as np
import pytest
import xarray

import tuning
from experiments import demo
from tests.well_compiled import well_compiled

WRITTEN = {
    "demo.json", "fit.png", "fit.toml", "map.nc", "map.png", "record.nc", "tuned.png", "tuned.toml",
}  # fmt: skip


def test_identification_sweep_and_tuning(tmp_path, capsys, monkeypatch):
    identify = tuning.identify

    def identify_optimised(*arguments):
        with well_compiled():
            return identify(*arguments)

    monkeypatch.setattr(tuning, "identify", identify_optimised)
    demo.run(tmp_path / "out", json=True)
    assert {path.name for path in (tmp_path / "out").iterdir()} == WRITTEN
    summary = json.loads(capsys.readouterr().out)
    numbers, truth = summary["numbers"], summary["truth"]
    assert numbers.keys() == truth.keys()
    intervals = {name: number["interval_95"] for name, number in numbers.items()}
    hits = [low <= truth[name] <= high for name, (low, high) in intervals.items()]
    assert sum(hits) >= len(hits) - 1
    with xarray.open_dataset(tmp_path / "out" / "map.nc") as results:
        assert not results.failed.any()
        sizes = {**dict.fromkeys(demo.SWEPT_VALUES, 45), "sensor": 3}
        assert results.peak_deflection.sizes == sizes
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
