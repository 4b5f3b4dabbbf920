"""Each benchmark on its cheapest real path; for the other solvers see `test_baselines`."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from experiments import benchmarks
from experiments.benchmarks import (
    __main__,
    cases,
    controller_steps,
    first_answer,
    growth,
    quadratic_programs,
    trains,
)
from experiments.benchmarks.common import import_optional
from experiments.benchmarks.controller_steps import (
    MAX_STEPS,
    computing_times,
    patch_case,
    sample_indices,
    time_steps,
)
from experiments.benchmarks.first_answer import AXLES, ROWS, Row, train
from jaxbeam.case.controller import AbstractSampledLaw, ControlStep


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
@pytest.mark.filterwarnings("ignore::jaxbeam.control.sampled_lqr.SamplingWarning")
def test_sweeps_of_the_table_are_right_and_fully_measured(kind):
    row = cases.measure(*kind, modes=2, side=2)
    assert row["error"] < 1e-6 and row["scipy_error"] < 1e-6
    assert ("diffrax" in row) == (kind[1:] == ("open", "peaks"))
    assert row.get("diffrax_error", 0.0) < 1e-6
    assert row["run"] > 0 and row["scipy"] > 0
    assert np.isfinite(row["compile"])  # a first run less another one: about 0 if none compiles
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


# Computing times of steps: the worst step among others, times at which steps are taken.


class RepeatedProductLaw(AbstractSampledLaw):
    """Law that multiplies by a matrix as often as its reading says; its state is its command."""

    matrix: Any

    def initial_state(self):
        return jnp.zeros(1)

    def step(self, state, measurement, t):
        rounds = measurement.readings[0].astype(int)
        end = jax.lax.fori_loop(0, rounds, lambda _, x: jnp.tanh(self.matrix @ x), jnp.ones(6) + t)
        return ControlStep(end[:1] + state, end[:1])


def test_worst_step_differs_from_the_median():
    """Forty steps of twenty rounds, and one of six hundred."""
    readings = np.full((41, 1), 20.0)
    readings[20] = 600.0
    measurements = jnp.asarray(readings), jnp.zeros((41, 0)), jnp.zeros((41, 1))
    times = time_steps(RepeatedProductLaw(jnp.eye(6) + 0.1), measurements, jnp.arange(41) * 0.01)
    assert 8 * times.median < times.worst < 100 * times.median
    assert 1e-8 < times.median < 1e-4
    # In a batch every step takes as long as the slowest, but 256 share the call.
    assert times.median < times.batched <= times.batched_worst


def test_steps_of_a_run_are_timed():
    record = jb.simulate(patch_case(jb.Feedback(gains=[2e3], period=0.01)), tolerance=1e-4)
    times = computing_times(record)
    assert 1e-9 < times.median <= times.worst < 1e-2
    assert 1e-9 < times.batched <= times.batched_worst < 1e-2


def test_runs_without_a_sampled_controller_have_no_computing_times():
    record = jb.simulate(patch_case(jb.Prescribed(offsets=[1.0])), tolerance=1e-4)
    with pytest.raises(ValueError, match="a controller with a period"):
        computing_times(record)


def test_steps_are_the_samples_at_multiples_of_the_period():
    times = np.arange(0, 1001) / 1000
    assert sample_indices(times, 0.01).tolist() == list(range(0, 1001, 10))
    assert sample_indices(times, 1e-4).size == MAX_STEPS


# Benchmark of first answers: rows, goals, and the script it is compared with.


def test_every_row_is_a_command_or_a_call_of_a_valid_case(tmp_path):
    for row in ROWS:
        assert bool(row.command) != bool(row.code), row.name
        compile(f"{row.setup}\n{row.code}", row.name, "exec")
    for i, text in enumerate({row.case for row in ROWS}):
        (tmp_path / f"{i}.toml").write_text(text)
        assert jb.load_case(tmp_path / f"{i}.toml").loads


def test_the_train_has_fifty_axles_in_mirrored_order(tmp_path):
    assert len(AXLES) == 50 and sorted(AXLES) == AXLES
    np.testing.assert_allclose(np.diff(AXLES), np.diff(AXLES)[::-1], rtol=1e-12)
    (tmp_path / "case.toml").write_text(train(4))
    assert len(jb.load_case(tmp_path / "case.toml").loads) == 4


def test_the_script_agrees_with_jaxbeam(tmp_path):
    _, found = first_answer.measure_script(tmp_path)
    assert first_answer.check_script(found) < 1e-8
    wrong = found | {"peaks": [1.00001 * peak for peak in found["peaks"]]}
    with pytest.raises(ValueError, match="differ by 1.0e-05"):
        first_answer.check_script(wrong)


def test_calls_commands_and_errors_are_timed_and_rows_that_follow_find_the_files(tmp_path):
    first = Row("file", 1.0, code="open('mark', 'w').close()")
    second = Row("again", 1.0, code="import os; os.stat('mark')", again=True)
    assert first_answer.groups([first, second, first]) == [[first, second], [first]]
    for seconds in first_answer.measure_rows([first, second], repeat=1):
        assert 0 <= seconds.wall < 1
    refused = Row("refused", 1.0, ("simulate", "{case}", "--plott"), fails=True)
    assert first_answer.measure_row(refused, tmp_path).processor > 0.01
    with pytest.raises(RuntimeError, match="--plott"):
        first_answer.measure_row(refused._replace(fails=False), tmp_path)


def test_a_star_marks_a_goal_missed_beyond_the_import_of_jax():
    jax_import, row = first_answer.Seconds(0.5, 0.4), Row("name", 1.0, beyond_jax=True)
    assert first_answer.table_line(row, first_answer.Seconds(1.4, 3.0), jax_import)[-1] == "+ 1"
    late = first_answer.table_line(row, first_answer.Seconds(1.6, 1.2), jax_import)
    assert late == ("name", "1.60", "1.20", "+ 1 *")
