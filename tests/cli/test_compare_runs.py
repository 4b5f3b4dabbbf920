"""Command `compare` over random runs."""

import json

import pytest

from jaxbeam.cli import main

CASE = """
[beam]
length = 0.6
flexural_rigidity = 12.0
mass_per_length = 0.5
damping_ratio = 0.03
modes = 1
[[sensors]]
position = 0.3
[[actuators]]
kind = "point"
position = 0.3
limits = [-2.0, 5.0]
[[loads]]
kind = "mass"
mass = 0.4
speed = 2.0
entry_time = 0.1
[controller]
kind = "feedback"
gains = [500.0]
period = 0.02
[run]
duration = 0.5
sample_rate = 100.0
"""
RUNS = """
[training]
draws = 2
"loads.0.mass" = [0.3, 0.4]
"beam.flexural_rigidity" = [11.0, 13.0]
"""


def test_compare_over_the_runs_of_a_file(tmp_path, capsys):
    case, runs = tmp_path / "weak.toml", tmp_path / "runs.toml"
    case.write_text(CASE)
    runs.write_text(RUNS)
    with pytest.raises(SystemExit, match="0"):
        main(["compare", str(case), "--cases", str(runs), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert list(found["over_all"]) == ["weak", "drawn by hand"]
    assert len(found["cases"]) == 2
    assert all(11 < one["values"]["beam.flexural_rigidity"] < 13 for one in found["cases"])
    shares = [one["controllers"]["weak"]["share"] for one in found["cases"]]
    assert found["over_all"]["weak"]["worst_share"] == min(shares)
    with pytest.raises(SystemExit, match="1"):
        main(["compare", str(case), "--cases", str(runs), "--over", "loads.0.mass=1,2"])
    assert "--cases has runs of its own" in capsys.readouterr().err
