"""Command line of fits: calls of the library, files written, and refusals."""

import json

import numpy as np
import pytest

import tuning
from jaxbeam.cli import main
from tests.cli.example import CASE
from tests.tuning import stand_in
from tuning.parameters.prior import Prior


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    """Run a command line in a folder with a case and a log; returns status, output and errors."""
    (tmp_path / "case.toml").write_text(CASE)
    (tmp_path / "runs.csv").write_text(
        "run,t [s],a [mm],b [mm]\n"
        + "".join(
            f"{run},{0.1 * i:.1f},{i % 3},{'' if i == 2 else i % 2}\n"
            for run in (1, 2)
            for i in range(6)
        )
    )
    monkeypatch.chdir(tmp_path)

    def call(line):
        with pytest.raises(SystemExit) as ended:
            main(line.split())
        printed = capsys.readouterr()
        return ended.value.code, printed.out, printed.err

    return call


def test_a_fit_with_all_options(call, tmp_path, monkeypatch):
    arguments = {}

    def identify(case, logs, free, **settings):
        arguments.update(case=case, logs=logs, free=free, settings=settings)
        return stand_in.fit()

    monkeypatch.setattr(tuning, "identify", identify)
    code, out, err = call(
        "identify case.toml runs.csv --free beam.flexural_rigidity=5:20 --free beam.damping_ratio"
        " --prior beam.damping_ratio=0.02:0.01 --scale beam.flexural_rigidity=log --loss huber"
        " --stage beam.flexural_rigidity --starts 4 --seed 7 --mask missing --mask spikes"
        " --profile sensors.0.offset --validate --report report -o fit.toml --plot"
    )
    assert code == 0, err
    assert [log.source for log in arguments["logs"]] == ["runs.csv:1", "runs.csv:2"]
    assert np.flatnonzero(~arguments["logs"][0].valid[:, 1]).tolist() == [2]
    assert arguments["free"] == {
        "beam.flexural_rigidity": Prior(5.0, 20.0, scale="log"),
        "beam.damping_ratio": Prior(mean=0.02, deviation=0.01),
    }
    assert arguments["settings"]["stages"] == [["beam.flexural_rigidity"]]
    assert arguments["settings"]["checkpoint"].name == "fit.search.npz"
    chosen = {key: arguments["settings"][key] for key in ("loss", "starts", "seed", "resume")}
    assert chosen == {"loss": "huber", "starts": 4, "seed": 7, "resume": False}
    assert "sensors.0.offset is between 0.19" in out and "run 2: predicted; " in out
    for name in ("fit.toml", "fit.npz", "fit.png", "report/report.html", "report/profiles.png"):
        assert (tmp_path / name).stat().st_size > 100
    code, _, err = call("identify case.toml runs.csv --free beam.length --report report")
    assert code == 1 and "the folder report is not empty" in err


def test_json(call, monkeypatch):
    monkeypatch.setattr(tuning, "identify", lambda *given, **settings: stand_in.fit())
    code, out, _ = call(
        "identify case.toml runs.csv --free beam.length --mask missing --json"
        " --profile sensors.0.offset --validate"
    )
    result = json.loads(out)
    assert code == 0 and len(result["left_out"]) == 3
    low, high = result["profiles"]["sensors.0.offset"]["interval"]
    assert low < 0.2 < high
    assert set(result["numbers"]) == set(stand_in.TRUTH)


REFUSED = [
    ("--free beam.length --prior beam.length=1", "--prior takes ADDRESS=MEAN:DEVIATION, such as"),
    ("--free beam.length --prior beam.damping_ratio=1:2", "beam.damping_ratio has a prior or a"),
    ("--free beam.length --scale beam.length=log", "the scale 'log' needs two bounds"),
    (
        "--free beam.length --mask missing --mask gaps",
        "'gaps' cannot be masked; dropouts, spikes, saturation, stuck can",
    ),
    ("--free beam.length --resume", "--resume goes on with what is kept beside the output: -o"),
    ("--validate", "the options of fits are for fitting a case; name what is free with --free"),
    ("--free beam.length", "runs.csv:1, line 4, column 'b': the cell is empty"),
    ("--free beam.length --mask missing --loss l1", "a loss is one of squares, soft-l1, huber"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED)
def test_wrong_options_end_in_one_error_message(call, options, message):
    code, out, err = call(f"identify case.toml runs.csv {options}")
    assert code in (1, 2) and out == "" and message in err and err.count("\n") == 1
