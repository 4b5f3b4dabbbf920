"""Each benchmark on its cheapest real path; for the other solvers see `test_baselines`."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxbeam as jb
from experiments import benchmarks
from experiments.benchmarks import (
    __main__,
    cases,
    controller_steps,
    growth,
    quadratic_programs,
)
from experiments.benchmarks.common import import_optional
from experiments.benchmarks.trains import __main__ as trains


def test_one_command_runs_all_benchmarks(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["benchmarks", "--list"])
    __main__.main()
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    folder = Path(benchmarks.__file__ or "").parent
    runnable = {path.stem for path in folder.glob("[a-z]*.py") if "def main()" in path.read_text()}
    runnable |= {path.parent.name for path in folder.glob("*/__main__.py")}
    assert set(listed) == runnable
    monkeypatch.setattr(sys, "argv", ["benchmarks", "sweeep"])
    with pytest.raises(SystemExit):
        __main__.main()
    assert "no benchmark sweeep; there are sweep, cases" in capsys.readouterr().err


@pytest.mark.parametrize("name", [name for name, one in __main__.BENCHMARKS.items() if one.quick])
def test_options_of_a_short_run_exist(name):
    path = Path(benchmarks.__file__ or "").with_name(f"{name}.py")
    source = (path if path.is_file() else path.with_suffix("") / "__main__.py").read_text()
    options = [word for word in __main__.BENCHMARKS[name].quick.split() if word.startswith("--")]
    if "--modes" in options and "modes=[" in source:
        options.remove("--modes")
    assert all(f'"{option}"' in source for option in options)


def test_packages_that_are_not_installed_are_none():
    assert import_optional("json") is not None
    assert import_optional("no_such_package") is None


@pytest.mark.parametrize(
    "kind",
    [
        (2, "open", "peaks"),
        (1, "sampled", "histories"),
    ],
)
@pytest.mark.filterwarnings("ignore::jaxbeam.control.optimal.sampled_lqr.SamplingWarning")
def test_sweeps_of_the_table_are_right_and_fully_measured(kind):
    row = cases.measure(*kind, modes=2, side=2)
    assert row["error"] < 1e-6 and row["scipy_error"] < 1e-6
    assert ("diffrax" in row) == (kind[1:] == ("open", "peaks"))
    assert row.get("diffrax_error", 0.0) < 1e-6
    times = [row[name] for name in ("run", "compile", "scipy")]
    assert all(np.isfinite(time) and time > 0 for time in times)
    assert row["memory"] > 50  # MiB; JAX alone takes as much


@pytest.fixture(scope="module")
def programs():
    return quadratic_programs.crossing_programs(4)


def test_solutions_of_the_programs_are_the_moves_of_the_crossing(programs):
    H, f, M, gamma = programs
    x, constrained, single, batch = quadratic_programs.solve_by_jaxbeam(H, f, M, gamma)
    law = jb.MPC(horizon=6, moves=4, **controller_steps.PREDICTIVE)
    case = controller_steps.patch_case(law)
    command = np.asarray(jb.simulate(case, tolerance=1e-4).command)[:, 0]
    moves = np.diff(command, prepend=0.0)
    np.testing.assert_allclose(x[:, 0], moves, atol=1e-6 * np.max(np.abs(moves)))
    assert 0.1 < np.mean(constrained) < 0.9
    assert batch > 0 and 0 < single < 1e-2


def test_osqp_solves_the_same_programs(programs):
    package = pytest.importorskip("osqp")
    H, f, M, gamma = programs
    scale = np.max(np.abs(H))
    x, reported, called = quadratic_programs.solve_by_osqp(package, H / scale, f / scale, M, gamma)
    by_jaxbeam = quadratic_programs.solve_by_jaxbeam(H, f, M, gamma)[0]
    atol = quadratic_programs.SOLUTION_TOLERANCE * np.max(np.abs(by_jaxbeam))
    np.testing.assert_allclose(x, by_jaxbeam, atol=atol)
    assert 0 < reported < called


def test_trains_have_the_peaks_of_the_script():
    found = trains.measure(np.array([45.0, 70.0]))
    assert found["difference"] < 2e-3
    assert 0 < found["processor"] < found["script"]


def test_growth_measures_times_and_memory():
    measured = growth.measure(25)
    assert 0 < measured["again"] < measured["first"] and measured["run"] > 0
    assert 50 < measured["before"] <= measured["peak"]


def test_steps_of_a_controller_are_timed():
    times = controller_steps.measure(controller_steps.CONTROLLERS["feedback, linear"])
    assert 0 < times.median <= times.worst < 1e-3


def test_a_profile_divides_the_time_between_stages():
    command = [sys.executable, "-m", "experiments.benchmarks.profile", "--modes", "3"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    rows = dict(line.strip("| ").split(" | ") for line in printed.splitlines()[2:])
    shares = {stage: float(share.rstrip(" %")) for stage, share in rows.items()}
    stages = " ".join(shares)  # XLA may have made one kernel of two stages
    assert all(stage in stages for stage in ("collocation", "propagation", "running_peaks"))
    assert 95 <= sum(shares.values()) <= 105


def test_what_is_printed_is_written_for_the_pages(tmp_path, monkeypatch):
    monkeypatch.setattr(__main__, "PAGES", tmp_path)
    __main__.write_page("sweep", "| a |\n| --- |\n\ntook 2 s in all\n")
    written = (tmp_path / "sweep.md").read_text(encoding="utf-8")
    assert re.fullmatch(r"\d+ cores, load [\d.]+, [\d-]{10}:\n\n\| a \|\n\| --- \|\n", written)
