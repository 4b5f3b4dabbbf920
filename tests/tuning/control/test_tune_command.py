"""Command line of tunings: calls of the library, files written, and refusals."""

import json
import types

import numpy as np
import pytest

import jaxbeam as jb
import tuning
import tuning.fit.result
from jaxbeam.analysis import stability
from jaxbeam.cli import main
from tests.tuning.small_rig import GAIN, RIGIDITY, dataset, fit, least_squares, rig

LOADS = '[training]\n"loads.0.mass" = [0.3, 0.5]\n[held_out]\n"loads.0.mass" = [0.4]\n'
TUNE = f"tune case.toml --cases loads.toml --free {GAIN}=500:7500 --no-least-peaks --steps 2"


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    """Run a command line in a folder with a case and loads; returns status, output and errors."""
    jb.save_case(rig(), tmp_path / "case.toml")
    (tmp_path / "loads.toml").write_text(LOADS)
    monkeypatch.chdir(tmp_path)

    def call(line):
        with pytest.raises(SystemExit) as ended:
            main(line.split())
        printed = capsys.readouterr()
        return ended.value.code, printed.out, printed.err

    return call


def test_from_a_fit_to_a_tuned_case(call, tmp_path, monkeypatch):
    """From the file written by identify to a tuned case that can be simulated."""
    monkeypatch.setattr(tuning.fit.result, "make_dataset", lambda case, logs: dataset())
    identified = fit(least_squares(free={RIGIDITY: None, "beam.damping_ratio": None}))
    tuning.save_fit(identified, tmp_path / "fit.npz")
    code, out, err = call(f"{TUNE} --fit fit.toml --plants 2 --aggregate cvar -o tuned.toml --json")
    assert code == 0, err
    result = json.loads(out)
    assert len(result["runs"]["training"]["cases"]) == 4
    assert len(result["runs"]["held out"]["cases"]) == 2
    by_hand = result["runs"]["held out"]["peak_drawn_by_hand"]
    assert np.all(np.array(by_hand) < result["runs"]["held out"]["uncontrolled_peak"])
    assert len(by_hand) == 2 and "peak_drawn_by_hand" not in result["runs"]["training"]
    plants = [run[RIGIDITY] for kind in result["runs"].values() for run in kind["cases"]]
    assert len(set(plants)) == 4
    assert np.all(np.abs(np.array(plants) - identified.values[0]) < 6 * identified.errors[0])
    tuned = jb.load_case(tmp_path / "tuned.toml")
    assert float(tuned.beam.flexural_rigidity) == identified.values[0]
    assert float(tuned.controller.gains[0]) == result["numbers"][GAIN]["after"]
    assert not (tmp_path / "tuned.search.npz").exists()
    assert call("simulate tuned.toml -o run.nc")[0] == 0


def test_arguments_of_a_pareto_front(call, tmp_path, monkeypatch):
    arguments = {}

    class Front:
        tuned = ()

        def __str__(self):
            return "a front"

    def pareto(*given, **options):
        arguments.update(given=given, options=options)
        return Front()

    monkeypatch.setattr(tuning, "pareto", pareto)
    code, out, err = call(f"{TUNE} --pareto effort=0.1,0.2 --limit after_exit=0.5 --aggregate mean")
    assert code == 0 and "a front" in out, err
    case, free, cases, objective, metric, limits = arguments["given"]
    assert free == {GAIN: (500.0, 7500.0)} and len(cases.training) == 2
    assert (metric, limits) == ("effort", [0.1, 0.2])
    assert objective == tuning.Objective({"peak": 1.0}, "mean", limits={"after_exit": 0.5})
    assert arguments["options"]["method"] == "lbfgs" and arguments["options"]["steps"] == 2


def test_arguments_of_the_other_kinds_of_tuning(call, monkeypatch):
    arguments = {}

    class Result:
        case = types.SimpleNamespace(controller=types.SimpleNamespace(open_loop=True))

        def to_dict(self):
            return {"verdict": "fine"}

    class IntegerSearch:
        best = Result()

    def lexicographic(*given, **options):
        arguments["lexicographic"] = given[3], options["aggregation"]
        return Result(), Result()

    def tune_integers(*given, **options):
        arguments["integers"] = given[1], options["method"]
        return IntegerSearch()

    def tune_reduced(*given, **options):
        arguments["states"] = given[1], list(given[2]), options["starts"]
        return Reduced()

    class Reduced:
        tuned = Result()

    margin = stability.StabilityMargin(2.0, 0.1)
    monkeypatch.setattr(stability, "stability_margin", lambda case: margin)
    monkeypatch.setattr(tuning.control, "lexicographic", lexicographic)
    monkeypatch.setattr(tuning.control, "tune_reduced", tune_reduced)
    monkeypatch.setattr(tuning.control, "tune_integers", tune_integers)
    printed = {"verdict": "fine", "stability": "stable"}
    assert json.loads(call(f"{TUNE} --lexicographic peak,effort --json")[1]) == printed
    assert json.loads(call(f"{TUNE} --integers controller.power=1,3 --json")[1])
    assert json.loads(call(f"{TUNE} --states 1 --starts 2 --json")[1]) == printed
    assert arguments == {
        "states": (1, [GAIN], 2),
        "lexicographic": (["peak", "effort"], "worst"),
        "integers": ({"controller.power": [1, 3]}, "adam"),
    }


REFUSED = {
    "--pareto effort": "--pareto takes METRIC=NUMBER",
    "--pareto effort=0.1 --lexicographic peak": "and --pareto are mutually exclusive",
    "--lexicographic peak --objective rms=1": "--lexicographic takes the place of --objective",
    "--pareto effort=0.1 --starts 3": "are for a single search, not for --pareto",
    "--integers controller.power=1 --resume": "are for a single search, not for --integers",
    "--states 1": "only regulators, such as kind 'lqr', have states to leave out",
    "--integers controller.power=one": "--integers takes ADDRESS=NUMBER",
    "--posterior": "it needs --fit",
    "--extra-delay 0.01": "--extra-delay and --parameter-tolerance need --max-real-part",
    "--fit none.npz": "there is no such fit",
    "--method newton": "a method is one of adam, lbfgs, bfgs",
    "--limit effort": "--limit takes NAME=NUMBER, such as effort=0.3",
    "-o tuned.txt": "a tuned case is written to a .toml file",
}


@pytest.mark.parametrize("options", REFUSED)
def test_contradictory_options_are_refused(call, options):
    code, _, err = call(f"{TUNE} {options}")
    assert code != 0 and REFUSED[options] in " ".join(err.split())
