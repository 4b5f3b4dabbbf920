"""Each benchmark on its cheapest real path; for their baselines see `test_baselines`."""

import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from experiments import benchmarks
from experiments.benchmarks import (
    __main__,
    cases,
    controller_steps,
    growth,
    identification,
    quadratic_programs,
    regulator_designs,
    tuning_methods,
)


def test_one_command_runs_all_benchmarks_there_are(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["benchmarks", "--list"])
    __main__.main()
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    folder = Path(benchmarks.__file__ or "").parent
    able = {path.stem for path in folder.glob("[a-z]*.py") if "def main()" in path.read_text()}
    assert set(listed) == able
    monkeypatch.setattr(sys, "argv", ["benchmarks", "sweeep"])
    with pytest.raises(SystemExit):
        __main__.main()
    assert "no benchmark sweeep; there are sweep, cases" in capsys.readouterr().err


def test_options_that_make_benchmarks_short_are_known_to_them():
    for name, (_, quick) in __main__.BENCHMARKS.items():
        source = Path(benchmarks.__file__ or "").with_name(f"{name}.py").read_text()
        assert all(f'"{word}"' in source for word in quick.split() if word.startswith("--"))


@pytest.mark.parametrize(
    "kind",
    [
        (2, "open", "peaks"),
        pytest.param((1, "sampled", "histories"), marks=pytest.mark.slow),
    ],
)
@pytest.mark.filterwarnings("ignore::jaxbeam.control.SamplingWarning")
def test_sweeps_of_the_table_are_right_and_all_is_told(kind):
    found = cases.measure(*kind, modes=2, side=2)
    assert found["error"] < 1e-6 and found["scipy_error"] < 1e-6
    assert ("diffrax" in found) == (kind[1:] == ("open", "peaks"))
    assert found.get("diffrax_error", 0.0) < 1e-6
    times = [found[name] for name in ("run", "compile", "scipy")]
    assert all(np.isfinite(time) and time > 0 for time in times)
    assert found["memory"] > 50  # MiB; JAX alone takes as much


@pytest.fixture(scope="module")
def programs():
    return quadratic_programs.programs(4)


def test_programs_are_those_whose_first_moves_the_crossing_saw(programs):
    H, f, M, gamma = programs
    x, felt, single, batch = quadratic_programs.by_jaxbeam(H, f, M, gamma)
    case = controller_steps.rig(jb.MPC(horizon=6, moves=4, **controller_steps.PREDICTIVE))
    command = np.asarray(jb.simulate(case, tolerance=1e-4).command)[:, 0]
    moves = np.diff(command, prepend=0.0)
    np.testing.assert_allclose(x[:, 0], moves, atol=1e-6 * np.max(np.abs(moves)))
    assert 0.1 < np.mean(felt) < 0.9
    assert batch > 0 and 0 < single < 1e-2


def test_osqp_solves_the_same_programs(programs):
    package = pytest.importorskip("osqp")
    H, f, M, gamma = programs
    scale = np.max(np.abs(H))
    x, own, called = quadratic_programs.by_osqp(package, H / scale, f / scale, M, gamma)
    ours = quadratic_programs.by_jaxbeam(H, f, M, gamma)[0]
    np.testing.assert_allclose(x, ours, atol=quadratic_programs.AGREED * np.max(np.abs(ours)))
    assert 0 < own < called


def test_growth_tells_times_and_memory():
    found = growth.measure(25)
    assert 0 < found["again"] < found["first"] and found["run"] > 0
    assert 50 < found["before"] <= found["peak"]


def test_steps_of_a_law_are_timed():
    found = controller_steps.measure(controller_steps.CONTROLLERS["feedback, linear"])
    assert 0 < found.median <= found.worst < 1e-3


def test_designs_are_timed():
    for times in (
        regulator_designs.time_invariant(2),
        regulator_designs.time_finite_horizon(2, 8, True, 1 / 256),
    ):
        assert times.compiling > 0 and times.run > 0


@pytest.mark.slow
def test_identification_by_scipy_comes_to_the_same_optimum(monkeypatch):
    monkeypatch.setattr(identification, "SPEEDS", np.array([2.0, 4.0]))
    found = identification.run()
    assert found["difference"] < 1e-5 < found["largest_error"]
    assert found["ratio"] > 1


@pytest.mark.slow
def test_evolution_never_does_worse_than_where_it_starts():
    case, free = tuning_methods.problem()
    start = tuning_methods.evolved(case, free, evaluations=1)
    assert jnp.isfinite(start.peak) and 0 < start.peak <= 0.83
    assert start.evaluations == 2 * 4 * len(free)


@pytest.mark.slow
def test_a_profile_puts_the_time_down_to_stages():
    command = [sys.executable, "-m", "experiments.benchmarks.profile"]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    rows = dict(line.strip("| ").split(" | ") for line in told.splitlines()[2:])
    shares = {stage: float(share.rstrip("%")) for stage, share in rows.items()}
    told_of = " ".join(shares)  # XLA may have made one kernel of two stages
    assert all(stage in told_of for stage in ("collocation", "propagation", "extremes"))
    assert 95 <= sum(shares.values()) <= 105
