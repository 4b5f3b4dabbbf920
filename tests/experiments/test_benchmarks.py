"""Each benchmark on its cheapest real path, and the other solvers that one compares.

The other solvers of the speed benchmark agree with each other and with oracles.
"""

import re
import subprocess
import sys
import time
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
from experiments.benchmarks.common import Timing, import_optional, time_call
from experiments.benchmarks.controller_steps import (
    MAX_STEPS,
    computing_times,
    patch_case,
    sample_indices,
    time_steps,
)
from experiments.benchmarks.first_answer import AXLES, ROWS, Row, train
from experiments.benchmarks.rivals import baselines, numba_peaks
from experiments.benchmarks.rivals.baselines import (
    PinnedBeam,
    crossing_rate,
    diffrax_peaks,
    free_times,
    hermite_peaks,
    reference_peaks,
    scipy_peaks,
    scipy_time,
)
from jaxbeam.case.controller import AbstractSampledLaw, ControlStep
from tests.oracles import modal_equations
from tests.oracles.closed_loop import Actuator, Clock, Sensor, respond
from tests.oracles.crossing import Load
from tests.oracles.modal_equations import Span
from tests.oracles.two_spans import TwoSpans


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


MASSES = np.array([0.1, 0.55, 1.0])
# The heavier masses peak after the exit at 5.3 and 10 m/s, all others while they cross.
SPEEDS = np.array([0.8, 2.2, 5.3, 10.0])


@pytest.fixture(scope="module")
def reference():
    return reference_peaks(PinnedBeam(3), MASSES, SPEEDS)


def test_scipy_agrees_to_one_in_a_million(reference):
    np.testing.assert_allclose(scipy_peaks(PinnedBeam(3), MASSES, SPEEDS), reference, rtol=1e-6)


@pytest.mark.parametrize("shared_steps", [False, True])
def test_diffrax_agrees_to_one_in_a_million(reference, shared_steps):
    peaks = diffrax_peaks(PinnedBeam(3), MASSES, SPEEDS, shared_steps=shared_steps)
    np.testing.assert_allclose(peaks, reference, rtol=1e-6)


def test_reference_agrees_with_the_coupled_equations_sampled_finely():
    """The full mass matrix, and no closed form after the exit."""
    beam, times = PinnedBeam(3), np.linspace(0.0, 0.6, 20_001)
    span = Span(beam.length, beam.flexural_rigidity, beam.mass_per_length, 3, beam.damping_ratio)
    run = modal_equations.respond(span, [Load(0.7, 6.0)], beam.sensors, times)
    rates = run.modal_rate @ span.shapes(np.array(beam.sensors)).T
    expected = reference_peaks(beam, [0.7], [6.0])[0, 0]
    peaks = hermite_peaks(np.diff(times), run.deflection, rates)
    np.testing.assert_allclose(peaks, expected, rtol=1e-7)


def test_cubic_peaks_are_exact_for_a_cubic_and_need_no_sample_at_the_peak():
    times = np.array([0.0, 0.7, 1.1])
    value = 2 * times**3 - 3 * times**2 + 0.9 * times - 0.5
    rate = 6 * times**2 - 6 * times + 0.9
    dip = (1 + np.sqrt(0.4)) / 2
    lowest = 2 * dip**3 - 3 * dip**2 + 0.9 * dip - 0.5
    peak = hermite_peaks(np.diff(times), value, rate)
    np.testing.assert_allclose(peak, abs(lowest), rtol=1e-14)


def test_free_times_cover_the_duration_and_thin_out_as_high_modes_decay():
    times = free_times(PinnedBeam(12))
    assert times[0] == 0.0 and times[-1] == 0.5
    assert np.all(np.diff(times) > 0)
    assert times[-2] - times[-3] > 5 * times[1]


def test_time_call_keeps_compiling_apart():
    timing = time_call(jax.jit(lambda x: x @ x), np.eye(50))
    assert 0 < timing.run < timing.compile
    assert np.isnan(timing.ratio)


def test_ratio_to_a_reference_does_not_depend_on_the_speed_of_the_machine(monkeypatch):
    """A machine that becomes slower with every call."""
    now, slowness = [0.0], [1.0]

    def work(seconds):
        now[0] += seconds * slowness[0]
        slowness[0] *= 1.1

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    timing = time_call(work, 6.0, repeat=3, reference=lambda: work(2.0))
    assert timing.ratio == pytest.approx(3.0, rel=0.01)
    assert timing.run > 7.0
    # The shortest calls are the first: that of the reference comes just before the other.
    assert timing.ratio_of_shortest == pytest.approx(3.0 * 1.1)


def test_scipy_time_scales_a_sample_to_the_whole_grid(monkeypatch):
    """Times that are a constant plus a share proportional to 1 / v are summed exactly."""
    masses, speeds = np.linspace(0.1, 1, 5), np.linspace(0.3, 10, 9)

    def known_time(function, beam, masses, speeds, repeat, reference):
        seconds = 0.01 + 0.02 / speeds[0]
        return Timing(
            run=seconds, ratio=3 / speeds[0], shortest=seconds / 2, reference_shortest=0.1
        )

    monkeypatch.setattr(baselines, "time_call", known_time)
    timing = scipy_time(scipy_peaks, PinnedBeam(1), masses, speeds, runs=4)
    np.testing.assert_allclose(timing.run, np.sum(0.01 + 0.02 / speeds) * len(masses))
    np.testing.assert_allclose(timing.ratio, np.sum(3 / speeds) * len(masses))
    np.testing.assert_allclose(timing.ratio_of_shortest, timing.run / 2 / 0.1)


@pytest.mark.parametrize("position", [0.1, 0.55, 0.7, 1.15])
def test_modes_of_two_spans_are_those_of_the_oracle(position):
    beam, oracle = PinnedBeam(6, 1.2, spans=2), TwoSpans(1.2, 11.68, 0.535, 6, 0.03)
    np.testing.assert_allclose(beam.frequencies, oracle.frequencies, rtol=1e-12)
    for order in (0, 1):
        expected = oracle.shapes(position, order)
        atol = 1e-12 * np.max(np.abs(expected))
        np.testing.assert_allclose(beam.shapes(position, order), expected, atol=atol)


@pytest.mark.parametrize("spans", [1, 2])
def test_scipy_histories_under_control_are_those_of_the_oracle(spans):
    """The oracle has a full mass matrix, and its own sensors, clock and patches."""
    beam = cases.pinned_beam(spans, "sampled", 4)
    kind = TwoSpans if spans == 2 else Span
    oracle = kind(beam.length, beam.flexural_rigidity, beam.mass_per_length, 4, beam.damping_ratio)
    edges = [(0.6 * i + 0.2575, 0.6 * i + 0.3425) for i in range(spans)]
    patches = [Actuator([(a, 1, 1.0), (b, 1, -1.0)], 8.292e-4 * 0.35 * 200) for a, b in edges]
    times = np.arange(0.0, 0.5, 0.02)
    expected = respond(
        oracle,
        [Load(0.7, 4.0)],
        patches,
        [Sensor(x) for x in beam.sensors],
        lambda readings, *_: -1e3 * readings[:spans],
        times.tolist(),
        Clock(0.01),
    )
    found = baselines.scipy_histories(beam, [0.7], [4.0], times)[0, 0]
    size = np.max(np.abs(expected.deflection))
    np.testing.assert_allclose(found, expected.deflection, atol=1e-6 * size)


def test_rate_off_the_beam_is_that_of_a_zero_mass():
    beam = PinnedBeam(3)
    state = np.random.default_rng(0).normal(size=(2, 3, 1))
    off_beam = crossing_rate(beam, np.ones(1), 1.0, None)(0.2, state)
    np.testing.assert_allclose(off_beam, crossing_rate(beam, np.zeros(1), 1.0)(0.2, state))


@pytest.mark.parametrize("modes", [3, 6])
def test_loops_for_numba_find_the_peaks_uncompiled(modes):
    beam = PinnedBeam(modes)
    expected = reference_peaks(beam, MASSES, SPEEDS)
    found = numba_peaks.numba_peaks(numba_peaks.compile_peaks(None), beam, MASSES, SPEEDS)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_numba_agrees_with_the_uncompiled_loops():
    package = pytest.importorskip("numba")
    found, plain = (
        numba_peaks.numba_peaks(numba_peaks.compile_peaks(p), PinnedBeam(3), MASSES, SPEEDS)
        for p in (package, None)
    )
    np.testing.assert_allclose(found, plain, rtol=1e-9)
