"""Tuning against searches without gradients, gradients of objectives, and checkpoints."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxbeam as jb
import tuning
from jaxbeam.analysis.sections import coil_history
from jaxbeam.analysis.stability import frozen_poles
from tests.case.test_actuators import LOOPS as INNER_LOOPS, PERIOD, crossing, shaker
from tests.differences import central
from tuning import checkpoint
from tuning.checkpoint import load, save
from tuning.control import penalised_objective
from tuning.control.objective import Objective
from tuning.control.optimisation import Optimisation
from tuning.control.run_set import make_run_set, run_case
from tuning.parameters import free_parameters

GAIN = "controller.gains.0"
RUNS = tuning.full_grid({"loads.0.mass": [0.3, 0.5], "loads.0.speed": [1.5]})


def rig(gain=2000.0, **options):
    beam = jb.Beam(
        length=0.6, flexural_rigidity=13.211, mass_per_length=0.812, damping_ratio=0.03, modes=2
    )
    patch = jb.Patch(
        start=0.2575, end=0.3425, moment_per_volt=8.292e-4, correction=0.32,
        amplifier_gain=200.0, limits=[-2.5, 7.5],
    )  # fmt: skip
    smooth = jb.Filter(cutoff=20.0, order=2, realisation="analogue")
    return jb.Case(
        beam=beam,
        actuators=[patch],
        sensors=[jb.Sensor(0.3, filter=smooth)],
        loads=[jb.MovingMass(mass=0.5, speed=1.5)],
        controller=jb.Feedback([gain], period=0.01),
        run=jb.Run(duration=0.6, sample_rate=200.0),
        **options,
    )


@pytest.fixture(scope="module")
def run_set():
    return make_run_set(rig(), RUNS, least_peaks=True)


@pytest.fixture(scope="module")
def metrics(run_set):
    """Metrics by gain and, if given, sharpness of the maxima, compiled once."""
    program = jax.jit(lambda *given: run_set.metrics(*given))
    return lambda gain, *sharp: program({GAIN: jnp.asarray(gain)}, *map(jnp.asarray, sharp))


def test_metrics_are_those_of_the_simulated_runs(metrics):
    metrics = metrics(5000.0)
    for i, run in enumerate(RUNS):
        record = jb.simulate(jb.replace(run_case(rig(), run), {GAIN: 5000.0}))
        plain = jb.simulate(run_case(jb.Case(rig().beam, sensors=rig().sensors, loads=rig().loads,
                                          run=rig().run), run))  # fmt: skip
        controlled, uncontrolled = np.abs(record.deflection), np.abs(plain.deflection)
        assert metrics["peak"][i] == pytest.approx(controlled.max() / uncontrolled.max(), rel=1e-4)
        assert metrics["rms"][i] == pytest.approx(
            np.sqrt(np.mean(controlled**2) / np.mean(uncontrolled**2)), rel=1e-4
        )
        limit = jb.bound(run_case(rig(), run)).peak
        shortfall = (controlled.max() - limit) / (uncontrolled.max() - limit)
        assert metrics["shortfall"][i] == pytest.approx(shortfall, rel=1e-3)
        late = np.asarray(record.times) > 0.4
        assert metrics["after_exit"][i] == pytest.approx(
            controlled[late].max() / uncontrolled.max(), rel=1e-3
        )
        effort = np.sqrt(np.mean(np.asarray(record.command) ** 2)) / 7.5
        assert metrics["effort"][i] == pytest.approx(effort, rel=1e-4)
        weight = 9.81 * run["loads.0.mass"]
        on = np.asarray(record.contact_force) != 0
        change = np.abs(np.asarray(record.contact_force) - weight)[on].max() / weight
        assert metrics["contact"][i] == pytest.approx(change, rel=1e-3)


def test_other_runs_share_the_programs(run_set):
    """Run sets are arguments of programs, which are compiled for their structure."""
    heavier = tuning.full_grid({"loads.0.mass": [0.32, 0.55], "loads.0.speed": [1.5]})
    other = make_run_set(rig(), heavier)
    unnamed = [dataclasses.replace(each, runs=()) for each in (run_set, other)]
    assert jax.tree.structure(unnamed[0]) == jax.tree.structure(unnamed[1])
    assert run_set.error != other.error
    record = other.records({})[0]
    assert np.all(record.step_errors >= other.sensor_errors)  # with those of peaks between steps


def test_gradients_of_the_objectives(run_set):
    """Of a sum of all: in forward mode, and from the metrics in reverse; see the next test."""
    weights = {"peak": 1.0, "rms": 0.3, "effort": 0.1, "contact": 0.2}
    objectives = [tuning.Objective(weights, over) for over in ("mean", "worst", "cvar")]

    def value(metrics):
        parts = [each.aggregate(each.weighted_metrics(metrics), 80.0) for each in objectives]
        return parts[0] + 0.7 * parts[1] + 0.4 * parts[2]

    @jax.jit
    def metrics_and_slopes(gain):
        along = lambda gain: run_set.metrics({GAIN: gain}, 80.0)  # noqa: E731
        return jax.jvp(along, (gain,), (jnp.ones(()),))

    metrics, slopes = metrics_and_slopes(4000.0)
    expected = central(lambda point: value(metrics_and_slopes(point[0])[0]), [4000.0], step=1.0)[0]
    assert jax.jvp(value, (metrics,), (slopes,))[1] == pytest.approx(expected, rel=1e-6)
    by_metric = jax.grad(value)(metrics)
    in_reverse = sum(jnp.vdot(by_metric[name], slopes[name]) for name in metrics)
    assert in_reverse == pytest.approx(expected, rel=1e-6)


def test_forward_and_reverse_gradients_are_equal(run_set, monkeypatch):
    """And equal to differences."""
    target = Objective().target
    search = Optimisation(run_set, free_parameters([rig()], dict(FREE), 1.0), Objective())
    points = jnp.asarray(search.start_points(2, 1))
    values_and_gradients = penalised_objective.values_and_gradients.__wrapped__

    def objectives_and_gradients(points):
        return values_and_gradients(*search._step_arguments(points, 40.0, range(len(RUNS)), target))

    (smooth, true), forward = jax.jit(objectives_and_gradients)(points)
    monkeypatch.setattr(penalised_objective, "MAX_FORWARD_PARAMETERS", 0)
    in_reverse = jax.jit(lambda points: objectives_and_gradients(points))
    values, reverse = in_reverse(points)
    np.testing.assert_allclose([smooth, true], values, rtol=1e-12)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    expected = central(lambda y: in_reverse(y[:, None])[0][0].sum(), points[:, 0], step=1e-4)
    np.testing.assert_allclose(forward[:, 0], expected, rtol=1e-5)


def test_smooth_maxima_converge_to_the_true_ones(metrics):
    true = metrics(4000.0)["peak"]
    for sharpness in (100.0, 1000.0):
        smooth = metrics(4000.0, sharpness)["peak"]
        assert np.all(smooth >= true) and np.all(smooth - true < np.log(200) / sharpness)


CASES = tuning.LoadCases(RUNS, tuning.full_grid({"loads.0.mass": [0.4], "loads.0.speed": [1.2]}))
FREE, OPTIONS = {GAIN: (500.0, 40000.0)}, {"steps": 25, "starts": 2, "progress": False}


@pytest.fixture(scope="module")
def tuned():
    return tuning.tune(rig(), FREE, CASES, **OPTIONS)


def test_the_minimum_is_that_of_a_search_without_gradients(metrics, tuned):
    def peak(gain):
        return float(np.max(metrics(gain)["peak"]))

    gains = np.geomspace(500.0, 40000.0, 60)
    values = [peak(gain) for gain in gains]
    low, high = gains[max(np.argmin(values) - 1, 0)], gains[min(np.argmin(values) + 1, 59)]
    best = scipy.optimize.minimize_scalar(peak, bounds=(low, high), method="bounded")
    assert tuned.run_sets[0].objective[1] <= best.fun * 1.002
    assert tuned.run_sets[0].objective[1] < tuned.run_sets[0].objective[0]


def test_the_result_on_training_and_held_out_runs(tuned):
    training, held_out = tuned.run_sets
    for outcome in tuned.run_sets:
        # Least peaks hold at samples; peaks between them may be slightly larger.
        assert np.all(outcome.peaks_after >= outcome.least_peaks * (1 - 1e-3))
        assert np.all(outcome.attained_shares(outcome.uncontrolled_peaks) == 0)
        assert np.all(outcome.attained_shares(outcome.least_peaks) == 1)
    run = held_out.runs[0]
    record = jb.simulate(run_case(tuned.case, run))
    assert held_out.peaks_after[0] == pytest.approx(float(record.peak_deflection[0]), rel=1e-4)
    assert tuned.verdict.startswith("objective on training ")
    assert "worst held out run: peak" in tuned.verdict
    assert f"at least {held_out.attained_shares(held_out.peaks_after).min():.1%}" in tuned.verdict
    assert GAIN in str(tuned) and "held out runs: peaks in mm" in str(tuned)
    assert "loads.0.mass (kg)  loads.0.speed (m/s)  no control" in str(tuned)
    assert tuned.to_dict()["numbers"][GAIN]["after"] == tuned.values[0]
    assert tuned.history.shape == (25, 2) and tuned.rejected_steps == 0
    label = tuned.plot().axes[0].get_yticklabels()[0].get_text()
    assert " kg" in label and " m/s" in label


def test_another_seed_reaches_the_same_objective(tuned):
    cases = tuning.LoadCases(RUNS)
    again = tuning.tune(rig(9000.0), FREE, cases, seed=5, least_peaks=False, **OPTIONS)
    assert again.run_sets[0].objective[1] == pytest.approx(tuned.run_sets[0].objective[1], rel=2e-3)
    assert "nothing was held out" in again.verdict


def test_a_stopped_search_is_resumed_to_the_same_result(tuned, tmp_path, monkeypatch):
    file = tmp_path / "search.npz"

    def save_and_stop(*arguments):
        save(*arguments)
        raise KeyboardInterrupt

    options = OPTIONS | {"least_peaks": False}
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(checkpoint, "save", save_and_stop)
        tuning.tune(rig(), FREE, CASES, checkpoint=file, **options)
    with pytest.raises(FileExistsError, match="resume that search"):
        tuning.tune(rig(), FREE, CASES, checkpoint=file, **options)
    with pytest.raises(ValueError, match="belongs to another search"):
        tuning.tune(rig(2500.0), FREE, CASES, checkpoint=file, resume=True, **options)
    resumed = tuning.tune(rig(), FREE, CASES, checkpoint=file, resume=True, **options)
    np.testing.assert_array_equal(resumed.history, tuned.history)
    np.testing.assert_array_equal(resumed.values, tuned.values)
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(ValueError, match="is damaged or cut off; delete it"):
        load(file, "")


def test_the_start_is_the_result_if_nothing_is_better():
    cases, free = tuning.LoadCases(RUNS), {GAIN: (1999.0, 2001.0)}
    worse = tuning.Objective({"effort": 1.0})
    options = OPTIONS | {"steps": 2, "least_peaks": False}
    tuned = tuning.tune(rig(1999.0), free, cases, worse, **options)
    assert tuned.run_sets[0].objective[1] <= tuned.run_sets[0].objective[0] * (1 + 1e-6)


PLAIN = jb.Case(rig().beam, loads=rig().loads, sensors=rig().sensors)


def test_tuning_with_a_stability_constraint():
    # With a heavy load frozen poles are unstable on the far half even without control.
    light = {"loads.0.mass": 0.05}
    cases, free = tuning.LoadCases((light,)), {GAIN: (50.0, 40000.0)}
    stable = tuning.StabilityConstraint(
        max_real_part=-0.5, extra_delay=0.005, parameter_tolerance={"beam.flexural_rigidity": 0.1}
    )
    tuned = tuning.tune(
        rig(100.0), free, cases, stable=stable, steps=20, least_peaks=False, progress=False
    )
    assert tuned.stability_violation == 0.0 and tuned.values[0] > 100.0
    # Against eigenvalues of cases with the delay and each change of the rigidity.
    delayed = jb.Feedback(tuned.case.controller.gains, period=0.01, delay=0.005)
    for factor in (0.9, 1.0, 1.1):
        case = dataclasses.replace(run_case(tuned.case, light), controller=delayed)
        case = jb.replace(case, {"beam.flexural_rigidity": 13.211 * factor})
        assert frozen_poles(case, np.linspace(0.0, 0.4, 30)).largest_real_part.max() <= -0.5 + 0.1


def test_gradient_of_the_violation():
    violation = jax.jit(
        tuning.StabilityConstraint(max_real_part=-50.0, instants=2).violation_function(
            [run_case(rig(), RUNS[0])]
        )
    )
    gradient = jax.grad(lambda gain: violation({GAIN: gain}))(3000.0)
    expected = central(lambda point: violation({GAIN: point[0]}), [3000.0], step=3.0)[0]
    assert gradient == pytest.approx(expected, rel=1e-4)


BAD = [
    (
        {"stable": tuning.StabilityConstraint(parameter_tolerance={"beam.stiffness": 0.1})},
        "no number at address",
    ),
    ({"free": {}}, "name at least one address as free"),
    ({"free": {"controller.gain": None}}, "did you mean 'controller.gains"),
    ({"free": {GAIN: (5000.0, 9000.0)}}, f"{GAIN} starts at 2000, outside its bounds"),
    (
        {"objective": tuning.Objective({"shortfall": 1.0}), "least_peaks": False},
        "leave least_peaks on for it",
    ),
    ({"steps": 0}, "steps and starts must be 1 or more"),
    ({"cases": tuning.LoadCases(({"loads.0.speed": 0.5},))}, "run.duration is 0.6 s, but with"),
    ({"cases": tuning.LoadCases(({"loads.0.weight": 0.5},))}, "no number at address"),
    ({"case": PLAIN, "free": {"beam.length": None}}, "neither a controller nor absorbers"),
]


@pytest.mark.parametrize(("changes", "message"), BAD, ids=[message[:24] for _, message in BAD])
def test_wrong_arguments_are_refused(changes, message):
    arguments = {"case": rig(), "free": {GAIN: None}, "cases": tuning.LoadCases(RUNS)} | changes
    with pytest.raises(ValueError, match=message):
        tuning.tune(**arguments, progress=False)


def test_faulty_held_out_runs_are_refused_before_the_search(tmp_path):
    slow = tuning.LoadCases(training=RUNS, held_out=tuning.full_grid({"loads.0.speed": [0.7]}))
    with pytest.raises(ValueError, match="with loads.0.speed = 0.7 the last load leaves only at"):
        tuning.tune(rig(), FREE, slow, least_peaks=False, checkpoint=tmp_path / "search.npz")
    assert not list(tmp_path.iterdir())


def test_load_cases_from_a_file(tmp_path):
    file = tmp_path / "loads.toml"
    file.write_text(
        '[training]\n"loads.0.mass" = [0.2, 0.5]\n"loads.0.speed" = [1, 2]\n'
        '[held_out]\n"loads.0.mass" = [0.3]\n'
    )
    load_cases = tuning.read_load_cases(file)
    assert len(load_cases.training) == 4 and load_cases.held_out == ({"loads.0.mass": 0.3},)
    assert {"loads.0.mass": 0.2, "loads.0.speed": 2.0} in load_cases.training
    for text, message in {
        "[train]\na = [1]": "there is no table .train.; it has .training., .held_out.",
        '[training]\n"loads.0.mass" = 0.2': "training.loads.0.mass must be a list of numbers",
        "[training]": "there is nothing to tune on",
        "[training": "not valid TOML",
        '[training]\n"a" = [1.0]\n[held_out]\n"a" = [1.0]': "must not be trained on, but a = 1 is",
    }.items():
        file.write_text(text)
        with pytest.raises(ValueError, match=message) as caught:
            tuning.read_load_cases(file)
        assert str(file) in str(caught.value)
    with pytest.raises(FileNotFoundError, match="cannot read the file of load cases"):
        tuning.read_load_cases(tmp_path / "none.toml")


def test_faulty_objectives_are_refused():
    for weights, message in (({"peek": 1.0}, "no metric 'peek'"), ({}, "needs metrics"),
                             ({"peak": -1.0}, "positive, finite weights")):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            tuning.Objective(weights)
    with pytest.raises(ValueError, match="aggregation may be mean, worst, cvar"):
        tuning.Objective(aggregation="median")


def test_absorber_without_controller():
    """A search from a detuned absorber comes near the least peak of a fine grid."""
    case = jb.Case(
        jb.Beam(25.0, 30e9, 15e3, damping_ratio=0.01, modes=1),
        sensors=[jb.Sensor(12.5)],
        loads=[jb.Axles(offsets=[0.0, 18.0, 36.0, 54.0], forces=[1.7e5] * 4, speed=65.0)],
        absorbers=[jb.Absorber(12.5, mass=6e3, frequency=2.9, damping_ratio=0.1)],
        run=jb.Run(1.5, sample_rate=100.0),
    )
    free = {"absorbers.0.frequency": (2.5, 4.5)}
    cases = tuning.LoadCases(({"loads.0.speed": 65.0},), ({"loads.0.speed": 64.0},))
    result = tuning.tune(case, free, cases, steps=30, progress=False)
    grid = jb.sweep(case, {"absorbers.0.frequency": np.linspace(2.5, 4.5, 81)}, progress=False)
    least = grid.peak_deflection.values.min()
    without = jb.simulate(dataclasses.replace(case, absorbers=())).peak_deflection[0]
    training, held_out = result.run_sets
    assert training.uncontrolled_peaks[0] == pytest.approx(float(without), rel=1e-3)
    assert training.peaks_after[0] == pytest.approx(least, rel=5e-3)
    assert held_out.peaks_after[0] < held_out.uncontrolled_peaks[0]
    assert "least" not in str(result)
    for i, error in enumerate((0.0, -0.05, 0.05)):  # peaks over those without absorber
        off = (1 + error) * float(result.values[0])
        for outcome, speed in ((training, 65.0), (held_out, 64.0)):
            one = jb.replace(case, {"absorbers.0.frequency": off, "loads.0.speed": speed})
            peak = np.max(np.abs(jb.simulate(one).deflection)) / outcome.uncontrolled_peaks[0]
            assert outcome.detuned[i] == pytest.approx(float(peak), rel=1e-6)
    assert any(line.split()[:1] == ["-5%"] for line in str(result).splitlines())


# Gradients of metrics of compiled run sets through closed loops, against differences.
#
# The derivatives of runs by every number of every kind are in `tests/simulation/test_every_number`.

GRADIENT_RUNS = tuning.full_grid({"loads.0.mass": [0.3], "loads.0.speed": [1.5]})


def gradient_rig(controller):
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, damping_ratio=0.03, modes=1),
        actuators=[jb.Patch(0.2575, 0.3425, 8.292e-4, correction=0.32, amplifier_gain=200.0)],
        sensors=[jb.Sensor(0.25, filter=jb.Filter(cutoff=20.0, order=2, realisation="analogue"))],
        loads=[jb.MovingMass(mass=0.5, speed=1.5)],
        controller=controller,
        run=jb.Run(duration=0.5, sample_rate=100.0),
    )


def test_gradients_of_a_bending_moment():
    """The metric is of the statically corrected moment that records have."""
    case = gradient_rig(jb.Feedback([3000.0], period=0.02))
    sensors = (jb.Sensor(0.25), jb.Sensor(0.15, "moment"))
    case = dataclasses.replace(case, sensors=sensors, run=jb.Run(0.42, sample_rate=50.0))
    run_set = make_run_set(case, GRADIENT_RUNS, [0.25], quantities=("moment",))

    @jax.jit
    @jax.value_and_grad
    def metric(gain):
        return run_set.metrics({"controller.gains.0": gain}, 50.0)["moment"][0]

    value, slope = metric(jnp.asarray(3000.0))
    controlled, uncontrolled = (
        np.abs(jb.simulate(jb.replace(one, GRADIENT_RUNS[0])).sensor_values[:, 1])
        for one in (case, dataclasses.replace(case, controller=None))
    )
    expected = np.log(np.sum(np.exp(50.0 * controlled / uncontrolled.max()))) / 50.0
    np.testing.assert_allclose(value, expected, rtol=1e-4)
    above, below = (metric(jnp.asarray(3000.0 + h))[0] for h in (10.0, -10.0))
    np.testing.assert_allclose(slope, (above - below) / 20, rtol=1e-5)
    with pytest.raises(ValueError, match="'shear' is the largest shear at the sensors"):
        make_run_set(case, GRADIENT_RUNS, quantities=("shear",))


def test_through_limits_of_a_voltage():
    """Where the voltage saturates: the objective, its gradient, and the result without bounds."""
    actuator = shaker(INNER_LOOPS["current"], limits=[-0.2, 0.3])
    case = crossing(actuator, controller=jb.Feedback([1e3], period=PERIOD))
    runs = tuning.LoadCases(({"loads.0.mass": 0.08}, {"loads.0.mass": 0.12}))
    run_set = make_run_set(case, runs.training, least_peaks=True)
    objective = Objective({"peak": 1.0, "rms": 0.3}, "mean")

    @jax.jit
    def value(gain):
        metrics = run_set.metrics({GAIN: gain}, 40.0)
        return objective.aggregate(objective.weighted_metrics(metrics), 40.0)

    for gain in (600.0, 1500.0):
        assert np.isin([-0.2, 0.3], coil_history(jb.replace(case, {GAIN: gain})).voltage).any()
        # Steps within which no further point of a time step reaches a limit.
        expected = central(lambda point: value(point[0]), [gain], step=1e-4)[0]
        assert jax.jit(jax.grad(value))(gain) == pytest.approx(expected, rel=1e-6)
    free = {GAIN: (100.0, 5000.0)}
    found = tuning.tune(case, free, runs, objective, steps=12, progress=False)
    assert "no least achievable peaks, as actuators.0.limits bound the voltage" in found.verdict
    before, after = found.run_sets[0].objective
    gains = np.linspace(100.0, 2000.0, 39)
    true = jax.jit(
        lambda gain: objective.aggregate(objective.weighted_metrics(run_set.metrics({GAIN: gain})))
    )
    least = min(float(true(gain)) for gain in gains)
    assert after < before and after < least * 1.01
    with pytest.raises(ValueError, match="relative to the least achievable peaks, but"):
        tuning.tune(case, free, runs, Objective({"shortfall": 1.0}), progress=False)
