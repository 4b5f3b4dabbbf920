"""Each benchmark on its cheapest real path; baselines against what shares no code with them."""

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
    baselines,
    by_numba,
    cases,
    growth,
    identify,
    quadratic,
    riccati,
    steps,
    tuners,
)
from experiments.benchmarks.crossing import Rig, crossing_rate
from tests.oracles.closed_loop import Actuator, Clock, Sensor, respond
from tests.oracles.loads import Load
from tests.oracles.modal_equations import Span
from tests.oracles.two_spans import TwoSpans

MASSES, SPEEDS = np.array([0.1, 1.0]), np.array([2.2, 10.0])


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


@pytest.mark.parametrize("place", [0.1, 0.55, 0.7, 1.15])
def test_modes_of_two_spans_are_those_of_the_oracle(place):
    rig, oracle = Rig(6, 1.2, spans=2), TwoSpans(1.2, 11.68, 0.535, 6, 0.03)
    np.testing.assert_allclose(rig.frequencies, oracle.frequencies, rtol=1e-12)
    for order in (0, 1):
        expected = oracle.shapes(place, order)
        atol = 1e-12 * np.max(np.abs(expected))
        np.testing.assert_allclose(rig.shapes(place, order), expected, atol=atol)


@pytest.mark.parametrize("spans", [1, 2])
def test_scipy_histories_under_control_are_those_of_the_oracle(spans):
    """Through the full mass matrix, with sensors, clock and patches of its own."""
    rig = cases.plain(spans, "sampled", 4)
    kind = TwoSpans if spans == 2 else Span
    beam = kind(rig.length, rig.flexural_rigidity, rig.mass_per_length, 4, rig.damping_ratio)
    edges = [(0.6 * i + 0.2575, 0.6 * i + 0.3425) for i in range(spans)]
    patches = [Actuator([(a, 1, 1.0), (b, 1, -1.0)], 8.292e-4 * 0.35 * 200) for a, b in edges]
    times = np.arange(0.0, 0.5, 0.02)
    expected = respond(
        beam,
        [Load(0.7, 4.0)],
        patches,
        [Sensor(x) for x in rig.sensors],
        lambda readings, *_: -1e3 * readings[:spans],
        times.tolist(),
        Clock(0.01),
    )
    found = baselines.scipy_histories(rig, [0.7], [4.0], times)[0, 0]
    size = np.max(np.abs(expected.deflection))
    np.testing.assert_allclose(found, expected.deflection, atol=1e-6 * size)


def test_a_rate_off_the_beam_is_that_of_a_mass_of_none():
    rig = Rig(3)
    state = np.random.default_rng(0).normal(size=(2, 3, 1))
    away = crossing_rate(rig, np.ones(1), 1.0, None)(0.2, state)
    np.testing.assert_allclose(away, crossing_rate(rig, np.zeros(1), 1.0)(0.2, state))


@pytest.mark.parametrize("kind", [(2, "open", "peaks"), (1, "sampled", "histories")])
@pytest.mark.filterwarnings("ignore::jaxbeam.control.SamplingWarning")
def test_sweeps_of_the_table_are_right_and_all_is_told(kind):
    found = cases.measure(*kind, modes=2, side=2)
    assert found["error"] < 1e-6 and found["scipy_error"] < 1e-6
    assert ("diffrax" in found) == (kind[1:] == ("open", "peaks"))
    assert found.get("diffrax_error", 0.0) < 1e-6
    times = [found[name] for name in ("run", "compile", "scipy")]
    assert all(np.isfinite(time) and time > 0 for time in times)
    assert found["memory"] > 50  # MiB; JAX alone takes as much


@pytest.mark.parametrize("modes", [3, 6])
def test_loops_for_numba_find_the_peaks_uncompiled_too(modes):
    rig = Rig(modes)
    expected = baselines.reference_peaks(rig, MASSES, SPEEDS)
    found = by_numba.numba_peaks(by_numba.program(None), rig, MASSES, SPEEDS)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_numba_finds_what_the_same_loops_find_uncompiled():
    package = pytest.importorskip("numba")
    found, plain = (
        by_numba.numba_peaks(by_numba.program(p), Rig(3), MASSES, SPEEDS) for p in (package, None)
    )
    np.testing.assert_allclose(found, plain, rtol=1e-9)


@pytest.fixture(scope="module")
def programs():
    return quadratic.programs(4)


def test_programs_are_those_whose_first_moves_the_crossing_saw(programs):
    H, f, M, gamma = programs
    x, felt, single, batch = quadratic.by_jaxbeam(H, f, M, gamma)
    case = steps.rig(jb.MPC(horizon=6, moves=4, **steps.PREDICTIVE))
    command = np.asarray(jb.simulate(case, tolerance=1e-4).command)[:, 0]
    moves = np.diff(command, prepend=0.0)
    np.testing.assert_allclose(x[:, 0], moves, atol=1e-6 * np.max(np.abs(moves)))
    assert 0.1 < np.mean(felt) < 0.9
    assert batch > 0 and 0 < single < 1e-2


def test_osqp_solves_the_same_programs(programs):
    package = pytest.importorskip("osqp")
    H, f, M, gamma = programs
    scale = np.max(np.abs(H))
    x, own, called = quadratic.by_osqp(package, H / scale, f / scale, M, gamma)
    ours = quadratic.by_jaxbeam(H, f, M, gamma)[0]
    np.testing.assert_allclose(x, ours, atol=quadratic.AGREED * np.max(np.abs(ours)))
    assert 0 < own < called


def test_growth_tells_times_and_memory():
    found = growth.measure(25)
    assert 0 < found["again"] < found["first"] and found["run"] > 0
    assert 50 < found["before"] <= found["peak"]


def test_steps_of_a_law_are_timed():
    found = steps.measure(steps.CONTROLLERS["feedback, linear"])
    assert 0 < found.median <= found.worst < 1e-3


def test_designs_are_timed():
    for times in (riccati.invariant(2, 3), riccati.designs(2, 1, 8)):
        assert times.compiling > 0 and times.run > 0


@pytest.mark.slow
def test_identification_by_scipy_comes_to_the_same_optimum(monkeypatch):
    monkeypatch.setattr(identify, "SPEEDS", np.array([2.0, 4.0]))
    found = identify.run()
    assert found["difference"] < 1e-5 < found["largest_error"]
    assert found["ratio"] > 1


@pytest.mark.slow
def test_evolution_never_does_worse_than_where_it_starts():
    case, free = tuners.problem()
    start = tuners.evolved(case, free, evaluations=1)
    assert jnp.isfinite(start.peak) and 0 < start.peak <= 0.83
    assert start.evaluations == 2 * 4 * len(free)


@pytest.mark.slow
def test_a_profile_puts_the_time_down_to_stages():
    command = [sys.executable, "-m", "experiments.benchmarks.profile"]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    rows = dict(line.strip("| ").split(" | ") for line in told.splitlines()[2:])
    shares = {stage: float(share.rstrip("%")) for stage, share in rows.items()}
    assert {"collocation", "propagation", "extremes"} <= set(shares)
    assert 95 <= sum(shares.values()) <= 105
