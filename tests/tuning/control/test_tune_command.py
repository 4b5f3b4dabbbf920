"""Tunings as commands: calls of the library, files, refusals; what is killed is resumed."""

import json
import os
import signal
import subprocess
import sys
import types

import numpy as np
import pytest

import jaxbeam as jb
import tuning
import tuning.fit.result
from jaxbeam.analysis import stability
from jaxbeam.cli import main
from tests.tuning.small_rig import GAIN, RIGIDITY, dataset, fit, least_squares, rig
from tuning import checkpoint
from tuning.checkpoint import Checkpoint
from tuning.fit.least_squares import multi_start
from tuning.fit.uncertainty import sample

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


# Searches and samplings whose process is killed are resumed to the same results.

# Code of a process that is killed once it has written its first checkpoint.
CHILD = """
import os, signal, sys
import tuning.checkpoint
from pathlib import Path
from tests.tuning import small_rig
from tests.tuning.control import test_tune_command
from tuning.checkpoint import Checkpoint
from tuning.fit.least_squares import multi_start
from tuning.fit.uncertainty import sample
file = Path(sys.argv[1])
save = tuning.checkpoint.save
def save_and_die(path, digest, arrays):
    save(path, digest, arrays)
    os.kill(os.getpid(), signal.SIGKILL)
tuning.checkpoint.save = save_and_die
{task}
"""
SEARCH = """
problem = small_rig.least_squares()
multi_start(problem, problem.data.measured, 12, 1, Checkpoint(file, "digest"))
"""
TUNING = "test_tune_command.tuned(file)"
SAMPLE = "sample(small_rig.fit(), 200, 2, 50, checkpoint=file)"


def killed(task, file):
    line = [sys.executable, "-c", CHILD.format(task=task), str(file)]
    ended = subprocess.run(line, capture_output=True, env=os.environ)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert file.exists()


def tuned(file, **options):
    """A tuning in mini-batches from two starts, with a checkpoint unless `file` is None."""
    cases = tuning.LoadCases(tuning.full_grid({"loads.0.mass": [0.2, 0.3, 0.4]}))
    return tuning.tune(
        rig(), {GAIN: (500.0, 7500.0)}, cases, steps=12, starts=2, batch=2, least_peaks=False,
        progress=False, checkpoint=file, **options,
    )  # fmt: skip


def assert_resumed(file):
    """Check that a tuning that ended after its first checkpoint is resumed to the same result."""
    resumed, whole = tuned(file, resume=True), tuned(None)
    np.testing.assert_array_equal(resumed.history, whole.history)
    np.testing.assert_array_equal(resumed.values, whole.values)


def test_a_killed_tuning_is_resumed(tmp_path):
    killed(TUNING, tmp_path / "search.npz")
    assert_resumed(tmp_path / "search.npz")


def test_a_stopped_tuning_is_resumed(tmp_path, monkeypatch):
    """In one process, which compiles once."""
    save = checkpoint.save

    def save_and_stop(*arguments):
        save(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(checkpoint, "save", save_and_stop)
        tuned(tmp_path / "search.npz")
    assert_resumed(tmp_path / "search.npz")


def test_a_killed_multi_start_search_is_resumed(tmp_path):
    killed(SEARCH, tmp_path / "search.npz")
    problem = least_squares()
    arguments = problem, problem.data.measured, 12, 1
    resumed = multi_start(*arguments, Checkpoint(tmp_path / "search.npz", "digest"))
    for one, other in zip(resumed, multi_start(*arguments), strict=True):
        assert one.cost == other.cost and one.starts == other.starts
        np.testing.assert_array_equal(one.values, other.values)


def test_a_killed_sampling_is_resumed(tmp_path):
    pytest.importorskip("blackjax")
    killed(SAMPLE, tmp_path / "draws.npz")
    resumed = sample(fit(), 200, 2, 50, checkpoint=tmp_path / "draws.npz", resume=True)
    np.testing.assert_array_equal(resumed.draws, sample(fit(), 200, 2, 50).draws)
