"""Limits, Pareto fronts, ranks, optimisers, mini-batches and integers, on one small rig."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxbeam as jb
import tuning
from tests.tuning.small_rig import GAIN, rig
from tuning.control.objective import METRICS
from tuning.control.optimisation import METHODS, optimiser
from tuning.control.pareto import with_integers
from tuning.control.run_set import make_run_set
from tuning.control.tuning_result import RunSetResult

FREE = {GAIN: (500.0, 7500.0)}  # from 12000 on the loop is unstable, with further minima
RUNS = tuning.full_grid({"loads.0.mass": [0.2, 0.3, 0.4, 0.5]})
CASES = tuning.LoadCases(RUNS, ({"loads.0.mass": 0.35},))
OPTIONS = {"steps": 40, "least_peaks": False, "progress": False}


@pytest.fixture(scope="module")
def swept():
    """Metrics of the worst run at many gains, which searches must come close to."""
    run_set = make_run_set(rig(), RUNS)
    metrics = jax.jit(lambda gain: run_set.metrics({GAIN: gain}))
    gains = np.geomspace(500.0, 7500.0, 90)
    rows = [metrics(jnp.asarray(gain)) for gain in gains]
    return {name: np.array([float(np.max(row[name])) for row in rows]) for name in METRICS}


@pytest.mark.parametrize("method", ["adam", "lbfgs", "bfgs"])
def test_every_method_finds_what_a_sweep_finds(swept, method):
    tuned = tuning.tune(rig(), FREE, CASES, method=method, starts=2, seed=3, **OPTIONS)
    assert tuned.run_sets[0].objective[1] <= swept["peak"].min() * 1.002
    assert tuned.history.shape == (40, 2) and np.isfinite(tuned.history).all()
    values = [minimum.value for minimum in tuned.start_results]
    assert values == sorted(values) and len(values) == 2
    assert values[0] == pytest.approx(tuned.run_sets[0].objective[1], rel=1e-6)
    assert "minima by start:" in str(tuned)


def test_a_pareto_front(swept):
    limits = [0.15, 0.3, 0.22]
    front = tuning.pareto(
        rig(), FREE, CASES, tuning.Objective({"peak": 1.0}), "effort", limits, **OPTIONS
    )
    assert front.limits == (0.3, 0.22, 0.15)
    for limit, (effort, peak) in zip(front.limits, front.points(), strict=True):
        assert effort <= limit * 1.01
        # The lowest peak of the gains of the sweep within the limit.
        assert peak <= swept["peak"][swept["effort"] <= limit].min() * 1.005
    assert np.all(np.diff(front.points()[:, 1]) > 0)
    assert "effort held out" in str(front)
    front.plot()


def test_lexicographic_order(swept):
    first, second = tuning.control.lexicographic(
        rig(), FREE, CASES, ["peak", "effort"], slack=0.03, **OPTIONS
    )
    best, allowed = first.run_sets[0].metrics["peak"], second.objective.limits["peak"]
    assert allowed == pytest.approx(1.03 * best)
    assert second.run_sets[0].metrics["peak"] <= allowed * 1.01
    assert second.run_sets[0].metrics["effort"] < first.run_sets[0].metrics["effort"]
    most, least = (swept["effort"][swept["peak"] <= share * allowed].min() for share in (1.0, 1.01))
    assert 0.99 * least <= second.run_sets[0].metrics["effort"] <= 1.02 * most


def test_mini_batches(swept):
    """Steps on two of four runs reach the same objective, and repeat with the same seed."""
    options = OPTIONS | {"batch": 2}
    first, again = (tuning.tune(rig(), FREE, CASES, seed=1, **options) for _ in range(2))
    assert first.run_sets[0].objective[1] <= swept["peak"].min() * 1.01
    np.testing.assert_array_equal(first.history, again.history)
    other = tuning.tune(rig(), FREE, CASES, seed=2, **options)
    assert not np.array_equal(first.history, other.history)


def test_limits_that_held_out_runs_exceed_are_in_the_verdict():
    metrics = {"peak": 1.0, "effort": 0.3}
    peaks = (np.full(1, x) for x in (1.0, 0.9, 0.8, 0.7))
    outcome = RunSetResult("held out", ({},), *peaks, np.zeros(1), [1.0, 0.8], metrics)
    result = tuning.TuningResult(
        rig(), [], np.zeros(0), tuning.Objective(limits={"effort": 0.2, "peak": 1.0}),
        np.zeros((1, 1)), 0, [outcome, outcome],
    )  # fmt: skip
    assert result.limit_excess == {"effort": pytest.approx(0.1)}
    assert "effort exceeds its limit of 0.2 by 0.1" in result.verdict


def test_integers():
    case = with_integers(rig(jb.Feedback([1.0], period=0.01)), {"controller.power": 3})
    assert case.controller.power == 3
    for address, message in {
        "controller.horizon": "horizon",
        "sensors.4.order": "sensors.4",
        "beam.length": "beam.length is no integer",
    }.items():
        with pytest.raises(ValueError, match=message):
            with_integers(rig(), {address: 2})
    with pytest.raises(ValueError, match="at least one integer"):
        tuning.control.tune_integers(rig(), {}, FREE, CASES)


def test_the_best_integer_is_selected():
    """A power of 1 or 3 of the reading: with such gains a cubic law hardly acts."""
    search = tuning.control.tune_integers(
        rig(), {"controller.power": [1, 3]}, FREE, CASES, **(OPTIONS | {"steps": 3})
    )
    objectives = [each.run_sets[0].objective[1] for each in search.tuned]
    assert [each["controller.power"] for each in search.choices] == [1, 3]
    assert objectives[0] < objectives[1]
    assert search.best is search.tuned[0] and search.best.case.controller.power == 1
    assert "(best)" in str(search)


BAD = [
    ({"method": "newton"}, "a method is one of adam, lbfgs, bfgs"),
    ({"method": "bfgs", "batch": 2}, "a batch is for adam"),
    ({"batch": 9}, "batch must be between 1 and the 4 training runs"),
    ({"free": {"loads.0.mass": (0.1, 1.0)}}, "is free, but differs from run to run"),
    ({"free": {"controller.period": (0.001, 0.1)}}, "controller.period cannot be free"),
]


@pytest.mark.parametrize(("changes", "message"), BAD, ids=[words[:20] for _, words in BAD])
def test_wrong_arguments_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        tuning.tune(**({"case": rig(), "free": FREE, "cases": CASES} | changes), **OPTIONS)


def test_limits_are_checked():
    with pytest.raises(ValueError, match="limits of metrics must be positive and finite"):
        tuning.Objective(limits={"effort": 0.0})
    with pytest.raises(ValueError, match="there is no metric 'costs'"):
        tuning.pareto(rig(), FREE, CASES, tuning.Objective(), "costs", [1.0])
    with pytest.raises(ValueError, match="each once, the most important first"):
        tuning.control.lexicographic(rig(), FREE, CASES, ["peak", "peak"])


def test_latin_hypercube_of_load_cases(tmp_path):
    rows = tuning.latin_hypercube({"a": (1.0, 2.0), "b": (0.0, 8.0)}, 8, seed=3)
    eighths = sorted(int((row["a"] - 1) * 8) for row in rows)  # of a Latin hypercube, one in each
    assert eighths == list(range(8)) == sorted(int(row["b"]) for row in rows)
    file = tmp_path / "loads.toml"
    file.write_text('[training]\ndraws = 8\nseed = 3\n"a" = [1.0, 2.0]\n"b" = [0.0, 8.0]\n')
    assert tuning.read_load_cases(file).training == rows
    for text, message in {
        'draws = 0\n"a" = [1.0, 2.0]': "the number of draws must be 1 or more",
        'draws = 2.5\n"a" = [1.0, 2.0]': "training.draws must be a whole number",
        'seed = 2\n"a" = [1.0, 2.0]': "training.seed is for drawing",
        'draws = 2\n"a" = [1.0, 2.0, 3.0]': "must be a range, low and high",
        'draws = 2\n"a" = [2.0, 1.0]': "a range must ascend",
    }.items():
        file.write_text("[training]\n" + text)
        with pytest.raises(ValueError, match=message):
            tuning.read_load_cases(file)


def test_cvar_is_the_mean_of_the_worst():
    values = jnp.array([3.0, 9.0, 1.0, 7.0])
    assert float(tuning.Objective(aggregation="cvar", tail_share=0.5).aggregate(values)) == 8.0
    assert dataclasses.replace(tuning.Objective(), aggregation="mean").aggregate(values) == 5.0


# Optimisers on functions whose minimum is known, also undefined at some points.

STARTS = jnp.array([[-1.2, 1.0], [0.5, -0.5], [1.3, 1.9]])


def valley(point):
    """Rosenbrock's function, undefined beyond x = 1.4."""
    x, y = point
    return jnp.where(x > 1.4, jnp.nan, 100 * (y - x**2) ** 2 + (1 - x) ** 2)


def bowl(point):
    return 3 * (point[0] - 0.3) ** 2 + point[0] * point[1] + (point[1] + 0.2) ** 2


def minimise(name, function, steps, stages=1):
    """Least values from all starts, and the number of points where the function is undefined."""
    method = optimiser(name, steps)
    evaluate = jax.jit(jax.vmap(jax.value_and_grad(function)))
    advance = jax.jit(jax.vmap(method.step, (0, 0, 0, 0, None)))
    points, states = STARTS, jax.vmap(method.init)(STARTS)
    best, undefined = np.full(len(STARTS), np.inf), 0
    for step in range(steps):
        value, gradient = evaluate(points)
        finite = np.isfinite(value)
        undefined += int((~finite).sum())
        best = np.fmin(best, np.where(finite, value, np.inf))
        gradient = jnp.where(finite[:, None], gradient, 0.0)
        changed = jnp.asarray(step % (steps // stages) == 0)
        value = jnp.where(finite, value, jnp.inf)
        points, states = advance(states, points, value, gradient, changed)
    return best, undefined


@pytest.mark.parametrize("name", METHODS)
def test_every_start_reaches_the_minimum(name):
    expected = scipy.optimize.minimize(bowl, [0.0, 0.0]).fun
    # Adam oscillates about the minimum with decreasing amplitude.
    steps, tolerance = (200, 1e-4) if name == "adam" else (60, 1e-9)
    best, _ = minimise(name, bowl, steps)
    np.testing.assert_allclose(best, expected, atol=tolerance)


@pytest.mark.parametrize("name", ["lbfgs", "bfgs"])
def test_quasi_newton_methods_follow_a_valley_and_return_from_undefined_points(name):
    best, undefined = minimise(name, valley, 120, stages=3)
    np.testing.assert_allclose(best, 0.0, atol=1e-9)
    assert name != "lbfgs" or undefined > 0


def test_adam_reverts_a_step_to_an_undefined_point_and_shortens_the_next():
    method = optimiser("adam", 10)
    start = jnp.zeros(1)
    first, state = method.step(method.init(start), start, jnp.ones(()), -jnp.ones(1), True)
    back, state = method.step(state, first, jnp.inf * jnp.ones(()), jnp.zeros(1), False)
    assert first[0] > 0 and back[0] == 0.0 and state.step_scale == 0.5
    again, _ = method.step(state, back, jnp.ones(()), -jnp.ones(1), False)
    assert 0 < again[0] < first[0]


def test_unknown_methods_are_refused():
    with pytest.raises(ValueError, match="one of adam, lbfgs, bfgs, not 'newton'"):
        optimiser("newton", 10)


# States to feed back: selection by relaxed shares, against every choice.

WEIGHT_FREE = {"controller.command_weight.0": (1e-5, 1e-1)}
WEIGHT_CASES = tuning.LoadCases(({"loads.0.mass": 0.3}, {"loads.0.mass": 0.5}))
WEIGHT_OPTIONS = {"steps": 30, "least_peaks": False, "progress": False}
FED_BACK_COUNT, STATE_COUNT = 1, 4


@pytest.fixture(scope="module")
def regulated():
    """Two modes under a regulator with weights set by hand."""
    law = jb.LQR(state_weight=[1e4, 1e4, 1.0, 1.0], command_weight=[1e-3], period=0.01)
    case = rig(law)
    return dataclasses.replace(case, beam=dataclasses.replace(case.beam, modes=2))


def test_the_states_selected_are_the_best_of_all_choices(regulated):
    reduced = tuning.control.tune_reduced(
        regulated, FED_BACK_COUNT, WEIGHT_FREE, WEIGHT_CASES, **WEIGHT_OPTIONS
    )
    objectives = {}
    for fed_back in itertools.combinations(range(STATE_COUNT), FED_BACK_COUNT):
        shares = np.isin(np.arange(STATE_COUNT), fed_back).astype(float)
        law = dataclasses.replace(regulated.controller, feedback=shares)
        one = tuning.tune(
            dataclasses.replace(regulated, controller=law),
            WEIGHT_FREE,
            WEIGHT_CASES,
            **WEIGHT_OPTIONS,
        )
        objectives[fed_back] = one.run_sets[0].objective[1]
    assert reduced.fed_back == min(objectives, key=objectives.get)
    rounded, end = reduced.tuned.run_sets[0].objective
    assert end <= rounded and end < 1.002 * objectives[reduced.fed_back]
    # The choice matters, and the sum of the shares is as required.
    assert max(objectives.values()) > 1.05 * end
    assert reduced.shares.sum() == pytest.approx(FED_BACK_COUNT, abs=0.05)
    np.testing.assert_array_equal(
        np.asarray(reduced.tuned.case.controller.feedback),
        np.isin(range(STATE_COUNT), reduced.fed_back),
    )
    assert "when the other parameters are tuned again" in str(reduced)


def test_wrong_controllers_and_numbers_of_states_are_refused(regulated):
    with pytest.raises(ValueError, match="only regulators, such as kind 'lqr'"):
        tuning.control.tune_reduced(rig(), 1, WEIGHT_FREE, WEIGHT_CASES)
    with pytest.raises(ValueError, match="keep must be 1 to 3 of the 4 states; it is 4"):
        tuning.control.tune_reduced(regulated, 4, WEIGHT_FREE, WEIGHT_CASES)
    with pytest.raises(ValueError, match="leave controller.feedback out of what is free"):
        tuning.control.tune_reduced(regulated, 2, {"controller.feedback.0": None}, WEIGHT_CASES)
