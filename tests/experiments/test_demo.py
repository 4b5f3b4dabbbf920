"""The demonstration does what the README says, from logs to a controller."""

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


@pytest.mark.slow
def test_three_jobs_in_a_row(tmp_path, capsys, monkeypatch):
    identify = tuning.identify

    def for_long(*given):
        with well_compiled():
            return identify(*given)

    monkeypatch.setattr(tuning, "identify", for_long)
    demo.run(tmp_path / "out", json=True)
    assert {path.name for path in (tmp_path / "out").iterdir()} == WRITTEN
    found = json.loads(capsys.readouterr().out)
    numbers, truth = found["numbers"], found["truth"]
    assert numbers.keys() == truth.keys()
    intervals = {name: number["interval_95"] for name, number in numbers.items()}
    hits = [low <= truth[name] <= high for name, (low, high) in intervals.items()]
    assert sum(hits) >= len(hits) - 1
    with xarray.open_dataset(tmp_path / "out" / "map.nc") as crossed:
        assert not crossed.failed.any()
        assert crossed.peak_deflection.sizes == {**dict.fromkeys(demo.MAP, 45), "sensor": 3}
    runs = found["tuned"]["runs"]["held out"]
    peaks = ("least_peak", "peak_after", "peak_before", "uncontrolled_peak")
    least, after, before, free = (np.array(runs[name]) for name in peaks)
    assert np.all(least < after) and np.all(before < free)
    # Tuned, the loop takes off far more than by hand.
    assert np.all(free - after > 1.5 * (free - before))


def test_a_folder_that_is_in_use_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="is not empty; choose another"):
        demo.run(tmp_path)
