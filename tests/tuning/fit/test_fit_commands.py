"""Command lines around fits: calls of the library, output, and refusals."""

import dataclasses
import json

import numpy as np
import pytest

import tuning
from jaxbeam.cli import main
from tests.cli.example import CASE
from tests.tuning import small_rig
from tests.tuning.fit import test_frequency_responses
from tuning.fit.experiment_design import ExperimentDesign
from tuning.fit.model_validation import HeldOutPrediction
from tuning.parameters import Prior

__all__ = ["call"]


def test_weighing(call, tmp_path, monkeypatch):
    fit = small_rig.fit()
    arguments = {}

    class Weighed:
        def __init__(self, *given, **settings):
            arguments.update(given=given, settings=settings)
            self.case = fit.case

        def to_dict(self):
            return {"loads": np.ones(2)}

        def __str__(self):
            return "one load found"

    monkeypatch.setattr(tuning, "weigh", Weighed)
    (tmp_path / "log.csv").write_text("t [s],a [mm]\n0,1\n1,2\n2,1\n")
    code, out, _ = call("weigh case.toml log.csv --speeds 0.5:3 --one-way -o found.toml")
    assert (code, out) == (0, "one load found\nwritten: found.toml\n")
    assert arguments["given"][2:] == ((0.5, 3.0), 3)
    assert arguments["settings"] == {"both_ways": False}
    code, out, _ = call("weigh case.toml log.csv --speeds 0.5:3 --json")
    assert json.loads(out) == {"loads": [1.0, 1.0]}
    code, _, err = call("weigh case.toml log.csv --speeds fast")
    assert code == 2 and "--speeds takes LOW:HIGH in m/s, such as 0.5:3, not 'fast'" in err


def test_influence_lines_of_several_logs_are_kept(call, tmp_path, monkeypatch):
    """Those found from two logs weigh a third at once, and a fourth from the file."""
    found = tuning.weighing.InfluenceLines(
        np.array([0.0, 0.3, 0.6]), np.array([[0.0], [-2e-6], [0.0]]), np.eye(3)[:, :, None], 20.0,
        np.array([[0.0], [1.0], [0.0]]), np.array([1.0]), np.array([0.02]),
    )  # fmt: skip
    calibrated, used = [], []

    class Weighed:
        def __init__(self, *given, **settings):
            used.append(settings["influence_lines"])

        def to_dict(self):
            return {"axles": []}

        def __str__(self):
            return "2 axles found"

    def calibrate(case, logs):
        calibrated.extend(log.source for log in logs)
        return found

    monkeypatch.setattr(tuning.weighing, "weigh_axles", Weighed)
    monkeypatch.setattr(tuning.weighing, "calibrate_influence_lines", calibrate)
    for name in ("log", "first", "second"):
        (tmp_path / f"{name}.csv").write_text("t [s],a [mm]\n0,1\n1,2\n2,1\n")
    weigh = "weigh case.toml log.csv --speeds 0.5:3 --axles auto"
    code, out, err = call(f"{weigh} --calibration first.csv --calibration second.csv")
    assert (code, out) == (0, "2 axles found\n"), err
    assert calibrated == ["first.csv", "second.csv"]
    code, out, err = call("weigh calibrate case.toml first.csv second.csv -o lines.json")
    assert code == 0 and out.endswith("written: lines.json\n"), err
    assert out.startswith("influence lines of ") and calibrated[2:] == ["first.csv", "second.csv"]
    code, out, err = call(f"{weigh} --calibration lines.json")
    assert code == 0 and len(calibrated) == 4, err
    for one, again in zip(used[0], used[1], strict=True):
        np.testing.assert_array_equal(one, again)
    (tmp_path / "bare.csv").write_text("1,2\n,2\n1,3\n")
    told = "--columns a[mm],- --rate 10 --missing mask"
    code, out, err = call(f"weigh calibrate case.toml bare.csv {told}")
    assert code == 0 and calibrated[4:] == ["bare.csv"], err
    (tmp_path / "other.json").write_text("[1, 2")
    code, _, err = call(f"{weigh} --calibration other.json")
    assert code == 1 and "other.json is not JSON" in err


def test_models_compared_and_held_out_logs(call, tmp_path, monkeypatch):
    """The criteria printed are those of the library; superfluous parameters raise them."""
    held = small_rig.least_squares({"beam.flexural_rigidity": None})
    fits = {"three": small_rig.fit(), "one": small_rig.fit(held)}
    for name in fits:
        (tmp_path / f"{name}.npz").touch()
    monkeypatch.setattr(tuning, "load_fit", lambda path: fits[path.stem])
    predictions = [HeldOutPrediction("new", np.array([1.1]))]
    monkeypatch.setattr(tuning.fit, "predict_held_out", lambda fit, logs: predictions)
    code, out, err = call("compare-models three.npz one.npz --held-out runs.csv")
    assert code == 1 and "the cell is empty" in err
    code, out, err = call("compare-models three.npz one.npz")
    assert code == 0, err
    header, first, second = out.splitlines()
    assert header.split() == ["model", "parameters", "log", "likelihood", "AIC", "BIC", "weight"]
    assert first.split()[:2] == ["one", "1"] and second.split()[:2] == ["three", "3"]
    assert float(first.split()[4]) == pytest.approx(tuning.fit.compare_fits(fits)[0].bic, rel=1e-5)
    (tmp_path / "new.csv").write_text("t [s],a [mm],b [mm]\n0,1,3\n1,2,2\n2,1,1\n")
    code, out, _ = call("compare-models one.npz --held-out new.csv")
    assert out == "one: new: predicted; residuals are 1.1 times the noise at most\n"
    result = json.loads(call("compare-models three.npz one.npz --held-out new.csv --json")[1])
    assert [rival["name"] for rival in result["models"]] == ["one", "three"]
    assert result["held_out"]["one"] == {"new": [1.1]}
    assert "one fit alone: give another" in call("compare-models one.npz")[2]


def test_design_of_an_experiment(call, monkeypatch):
    arguments, found = {}, []

    def design_experiment(case, free, over, **settings):
        arguments.update(free=free, over=over, settings=settings)
        design = ExperimentDesign(
            ["sensors.0.position"], ["m"], np.array([0.1]), np.array([0.3]), ["beam.length"],
            np.array([2.0]), np.array([1.0]), np.ones((1, 1)), case,
        )  # fmt: skip
        found.append(design)
        return design

    monkeypatch.setattr(tuning, "design_experiment", design_experiment)
    vary = "--vary sensors.0.position=0.1:0.5"
    line = f"design-experiment case.toml --free beam.length {vary} --noise 1e-6"
    code, out, err = call(f"{line} -o better.toml")
    assert code == 0, err
    assert arguments["over"] == {"sensors.0.position": (0.1, 0.5)}
    assert arguments["settings"] == {"target": None, "noise": 1e-6}
    assert "standard error of beam.length: 2 -> 1" in out and "written: better.toml" in out
    result = json.loads(call(f"{line} --json")[1])
    assert result["standard_errors"]["beam.length"] == {"before": 2.0, "after": 1.0}
    unseen = {"errors_before": np.array([np.inf]), "errors_after": np.array([np.inf])}
    design = dataclasses.replace(found[0], **unseen)
    assert "beam.length is not identifiable" in str(design)
    without_choice = call("design-experiment case.toml --free beam.length")[2]
    assert "name what can be chosen with --vary" in without_choice
    assert "--vary takes ADDRESS=VALUE" in call(f"{line} --vary loads.0.speed")[2]


def test_fit_to_responses(call, monkeypatch):
    fit = tuning.identify_responses(
        test_frequency_responses.CASE,
        test_frequency_responses.measured(),
        ["beam.flexural_rigidity"],
    )
    arguments = {}

    def identify_responses(case, measured, free):
        arguments.update(measured=measured, free=free)
        return fit

    monkeypatch.setattr(tuning.fit, "responses_of", lambda log, segment: (log.source, segment))
    monkeypatch.setattr(tuning, "identify_responses", identify_responses)
    line = "identify-responses case.toml new.csv --free beam.flexural_rigidity=5:20"
    assert "new.csv" in call(line)[2]
    with open("new.csv", "w") as file:
        file.write("t [s],a [mm],b [mm]\n0,1,3\n1,2,2\n2,1,1\n")
    code, out, err = call(f"{line} --segment 4 -o fit.toml")
    assert code == 0, err
    assert arguments == {
        "measured": ("new.csv", 4.0),
        "free": {"beam.flexural_rigidity": (5.0, 20.0)},
    }
    assert out == f"{fit}\nwritten: fit.toml\n"
    result = json.loads(call(f"{line} --json")[1])
    assert result["numbers"]["beam.flexural_rigidity"]["value"] == pytest.approx(fit.values[0])
    assert "name what to identify" in call("identify-responses case.toml new.csv")[2]


# Command line of fits: calls of the library, files written, and refusals.


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
        return small_rig.fit()

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
    monkeypatch.setattr(tuning, "identify", lambda *given, **settings: small_rig.fit())
    code, out, _ = call(
        "identify case.toml runs.csv --free beam.length --mask missing --json"
        " --profile sensors.0.offset --validate --draws 4"
    )
    result = json.loads(out)
    assert code == 0 and len(result["left_out"]) == 3
    assert len(result["posterior"]) > 1
    low, high = result["profiles"]["sensors.0.offset"]["interval"]
    assert low < 0.2 < high
    assert set(result["numbers"]) == set(small_rig.TRUTH)


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
