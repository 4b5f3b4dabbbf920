"""Command lines around fits: calls of the library, output, and refusals."""

import json

import numpy as np
import pytest

import tuning
from tests.tuning import stand_in
from tests.tuning.fit import test_frequency_responses
from tests.tuning.fit.test_identify_command import call
from tuning.fit.experiment_design import ExperimentDesign
from tuning.fit.model_validation import HeldOutPrediction

__all__ = ["call"]


def test_weighing(call, tmp_path, monkeypatch):
    fit = stand_in.fit()
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
    found = tuning.InfluenceLines(
        np.array([0.0, 0.3, 0.6]), np.array([[0.0], [-2e-6], [0.0]]), np.eye(3)[None], 20.0,
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

    monkeypatch.setattr(tuning, "weigh_axles", Weighed)
    monkeypatch.setattr(tuning, "calibrate_influence_lines", calibrate)
    for name in ("log", "first", "second"):
        (tmp_path / f"{name}.csv").write_text("t [s],a [mm]\n0,1\n1,2\n2,1\n")
    weigh = "weigh case.toml log.csv --speeds 0.5:3 --axles auto"
    runs = "--calibration first.csv --calibration second.csv --lines lines.json"
    code, out, err = call(f"{weigh} {runs}")
    assert (code, out) == (0, "2 axles found\nwritten: lines.json\n"), err
    assert len(calibrated) == 2
    code, out, err = call(f"{weigh} --calibration lines.json")
    assert code == 0 and len(calibrated) == 2, err
    for one, again in zip(used[0], used[1], strict=True):
        np.testing.assert_array_equal(one, again)
    (tmp_path / "other.json").write_text("[1, 2")
    code, _, err = call(f"{weigh} --calibration other.json")
    assert code == 1 and "other.json is not JSON" in err


def test_models_compared_and_held_out_logs(call, tmp_path, monkeypatch):
    """The criteria printed are those of the library; superfluous parameters raise them."""
    held = stand_in.least_squares({"beam.flexural_rigidity": None})
    fits = {"three": stand_in.fit(), "one": stand_in.fit(held)}
    for name in fits:
        (tmp_path / f"{name}.npz").touch()
    monkeypatch.setattr(tuning, "load_fit", lambda path: fits[path.stem])
    predictions = [HeldOutPrediction("new", np.array([1.1]))]
    monkeypatch.setattr(tuning, "predict_held_out", lambda fit, logs: predictions)
    code, out, err = call("compare-models three.npz one.npz --held-out runs.csv")
    assert code == 1 and "the cell is empty" in err
    code, out, err = call("compare-models three.npz one.npz")
    assert code == 0, err
    header, first, second = out.splitlines()
    assert header.split() == ["model", "parameters", "log", "likelihood", "AIC", "BIC", "weight"]
    assert first.split()[:2] == ["one", "1"] and second.split()[:2] == ["three", "3"]
    assert float(first.split()[4]) == pytest.approx(tuning.compare_fits(fits)[0].bic, rel=1e-5)
    (tmp_path / "new.csv").write_text("t [s],a [mm],b [mm]\n0,1,3\n1,2,2\n2,1,1\n")
    code, out, _ = call("compare-models one.npz --held-out new.csv")
    assert out == "one: new: predicted; residuals are 1.1 times the noise at most\n"
    result = json.loads(call("compare-models three.npz one.npz --held-out new.csv --json")[1])
    assert [rival["name"] for rival in result["models"]] == ["one", "three"]
    assert result["held_out"]["one"] == {"new": [1.1]}
    assert "one fit alone: give another" in call("compare-models one.npz")[2]


def test_design_of_an_experiment(call, monkeypatch):
    arguments = {}

    def design_experiment(case, free, over, **settings):
        arguments.update(free=free, over=over, settings=settings)
        return ExperimentDesign(
            ["sensors.0.position"], ["m"], np.array([0.1]), np.array([0.3]), ["beam.length"],
            np.array([2.0]), np.array([1.0]), np.ones((1, 1)), case,
        )  # fmt: skip

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

    monkeypatch.setattr(tuning, "responses_of", lambda log, segment: (log.source, segment))
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
