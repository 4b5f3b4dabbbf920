"""Discrete regulator: against scipy and python-control, sampling limits, cost."""

import dataclasses
import json
import warnings

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.linearised_loop import linearised_loop
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.cli import main
from jaxbeam.control.estimation.kalman import Kalman
from jaxbeam.control.estimation.observer import Observer
from jaxbeam.control.estimation.sampled_plant import sample_timing
from jaxbeam.control.lqr import LQR
from jaxbeam.control.sampled_lqr import (
    SamplingWarning,
    discrete_lq_problem,
    sampled_reachability,
    sampling_limit,
)
from jaxbeam.model.modes import mesh_layout
from tests.differences import central

WEIGHTS = {
    "state_weight": [1e3, 1e2, 10.0, 0.1, 0.01, 0.01, 0.0],
    "command_weight": [9e-5],
    "coordinates": "sine",
}


def beam_case(controller=None, modes=3, **shaker):
    """Rig of chapter 5 of the thesis, with its shaker at 0.5 m."""
    shaker = {"stiffness": 12000.0, "damping": 80.0, "force_per_volt": 4.6} | shaker
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=modes),
        actuators=[jb.Shaker(0.5, **shaker)],
        sensors=[jb.Sensor(0.25)],
        loads=[jb.MovingForce(force=5.0, speed=0.55)],
        controller=controller,
        run=jb.Run(0.2, sample_rate=500.0),
    )


def plant_of(case):
    layout = mesh_layout(case)
    return eqx.filter_jit(lambda case: jb.state_space(case, "sine", layout))(case)


@pytest.fixture(scope="module")
def model():
    return plant_of(beam_case())


@eqx.filter_jit
def designed_gain(controller, plant):
    return controller.time_invariant_gain(plant)


def assert_close(found, expected, tolerance):
    assert_allclose(found, expected, rtol=0, atol=tolerance * np.max(np.abs(expected)))


def integrate(A, B, Q, R, spans):
    """Transition and cost of (x, u1, u2), u1 held for the first span (s), u2 for the second.

    By Van Loan's block matrices.
    """
    n, m = B.shape
    state, cost = np.eye(n, n + 2 * m), np.zeros((n + 2 * m,) * 2)
    for i, span in enumerate(spans):
        command = np.eye(m, n + 2 * m, n + i * m)
        rate = np.block([[A, B], [np.zeros((m, n + m))]])
        cost_rate = scipy.linalg.block_diag(Q, R)
        parts = 64  # short ones, as the blocks contain a growing exponential
        block = np.block([[-rate.T, cost_rate], [np.zeros_like(rate), rate]]) * span / parts
        propagator = scipy.linalg.expm(block)
        transition = propagator[n + m :, n + m :]
        part_cost = transition.T @ propagator[: n + m, n + m :]
        for _ in range(parts):
            augmented = np.vstack([state, command])
            cost = cost + augmented.T @ part_cost @ augmented
            state = (transition @ augmented)[:n]
    return state, cost


@pytest.mark.parametrize("delay", [None, 0.7e-3])
def test_discrete_problem_against_the_integral(model, delay):
    plant, period = model.unloaded, 2e-3
    Q, R = LQR(**WEIGHTS).weights(model)
    A, B, Qs, Rs, N = discrete_lq_problem(
        plant.A, plant.B, Q, R, jnp.asarray(period), None if delay is None else jnp.asarray(delay)
    )
    spans = (0.0 if delay is None else delay, period - (delay or 0.0))
    state, cost = integrate(*map(np.asarray, (plant.A, plant.B, Q, R)), spans)
    units = np.sqrt(cost.diagonal() + 1e-12 * cost.max())
    found = np.block([[Qs, N], [N.T, Rs]])
    assert_allclose(found / np.outer(units, units), cost / np.outer(units, units), atol=1e-9)
    assert_close(np.hstack([A, B])[:7, :7], state[:, :7], 1e-10)
    assert_close(np.hstack([A, B])[:7, 7:], state[:, 7:], 1e-10)


@pytest.mark.parametrize("period", [2e-4, 2e-3])
def test_gain_against_scipy_and_python_control(model, period):
    plant = model.unloaded
    Q, R = LQR(**WEIGHTS).weights(model)
    state, cost = integrate(*map(np.asarray, (plant.A, plant.B, Q, R)), (0.0, period))
    A, B = state[:, :7], state[:, 8:]
    kept = np.r_[0:7, 8]
    cost = (cost + cost.T)[np.ix_(kept, kept)] / 2
    Q, N, R = cost[:7, :7], cost[:7, 7:], cost[7:, 7:]
    P = scipy.linalg.solve_discrete_are(A, B, Q, R, s=N)
    expected = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + N.T)
    found = designed_gain(LQR(**WEIGHTS, period=period, sampling="exact"), model)
    assert_close(found, expected, 1e-6)
    assert_close(found, control.dlqr(A, B, Q, R, N)[0], 1e-6)


@pytest.mark.parametrize("options", [{"delay": 1.5e-3}, {"input_rate_weight": [1e-6]}, {}])
def test_gain_has_the_least_cost(model, options):
    """The cost of runs from an initial state, integrated independently, is least for the gain."""
    law = LQR(**WEIGHTS, period=2e-3, **options, sampling="exact")
    gain = np.asarray(designed_gain(law, model))
    plant = model.unloaded
    A, B = np.asarray(plant.A), np.asarray(plant.B)
    Q, R = (np.asarray(weight) for weight in law.weights(model))
    delay, rate = options.get("delay", 0.0), options.get("input_rate_weight", [0.0])[0]
    state, period_cost = integrate(A, B, Q, R, (delay, law.period - delay))

    def cost(gain):
        x, last, total = np.array([1e-3, -4e-4, 2e-4, 0.03, 0.01, -0.1, 0.2]), np.zeros(1), 0.0
        for _ in range(600):
            command = -gain @ np.concatenate([x, last])[: gain.shape[1]]
            augmented = np.concatenate([x, last, command])
            total += (
                augmented @ period_cost @ augmented
                + rate * np.sum((command - last) ** 2) / law.period
            )
            x, last = state @ augmented, command
        return float(total)

    least = cost(gain)
    for change in np.random.default_rng(0).normal(size=(4, *gain.shape)):
        step = 5e-3 * change * np.abs(gain)
        up, down = cost(gain + step) - least, cost(gain - step) - least
        assert up > 0 and down > 0
        assert abs(up - down) < 0.3 * (up + down)


def test_sampling_limits():
    """Eq. (5.6) of the thesis: half a period of each damped mode.

    Without the suspension: pi / omega, omega_n = (n pi / L)^2 sqrt(EI / m), less the damping.
    """
    omega = (np.arange(1, 4) * np.pi / 0.6) ** 2 * np.sqrt(11.68 / 0.535)
    unsprung = beam_case(stiffness=0.0, damping=0.0)
    expected = np.pi / (omega * np.sqrt(1 - 0.03**2))
    assert_allclose(sampling_limit(unsprung), expected, rtol=1e-9)
    stiffer = sampling_limit(beam_case(damping=0.0))
    assert stiffer.shape == (3,) and np.all(stiffer < expected)


def test_controllability_is_lost_at_the_sampling_limit():
    """Of one mode: by Gramians, by the rank of (B, A B), and by poles under the optimal gain."""
    case = beam_case(modes=1, stiffness=0.0, damping=0.0, bandwidth=1e5)
    model = plant_of(case)
    plant, limit = model.unloaded, float(sampling_limit(case)[0])

    def reachability(period):
        """Smallest ratio of the sampled to the continuous modal Gramian, by scipy's equations."""
        forgetting = 0.5 / 0.2 * np.eye(3)
        A, B = np.asarray(plant.A) - forgetting, np.asarray(plant.B)
        transition = scipy.linalg.expm(A * period)
        input_matrix = np.linalg.solve(A, (transition - np.eye(3)) @ B)
        continuous = scipy.linalg.solve_continuous_lyapunov(A, -B @ B.T)
        held = scipy.linalg.solve_discrete_lyapunov(transition, input_matrix @ input_matrix.T)
        # Coordinates of the mode itself, without the lag of the actuator.
        values, rows, *_ = scipy.linalg.eig(A, left=True, right=False)
        row = rows[:, np.argmax(values.imag)].conj()
        rows = np.stack([row.real, row.imag])
        return scipy.linalg.eigvalsh(rows @ held @ rows.T / period, rows @ continuous @ rows.T)[0]

    ratios = []
    for share in (0.25, 0.5, 0.9, 1.0, 1.25, 2.0):
        ratio, omega = sampled_reachability(plant, share * limit, 0.2)
        assert omega == pytest.approx(np.pi / limit)
        assert_allclose(ratio, reachability(share * limit), rtol=1e-6, atol=1e-9)
        ratios.append(ratio)
    assert ratios[0] > 0.9 and ratios[1] > 0.7
    assert ratios[3] < 1e-6 and ratios[5] < 1e-6  # at the limit, and at twice that
    assert ratios[2] < 0.5 and ratios[4] < 0.5

    sampled = plant.discretize(limit)
    values, rows, *_ = scipy.linalg.eig(plant.A, left=True, right=False)
    row = rows[:, np.argmax(values.imag)].conj()
    controllability = np.stack([row, row.conj()]) @ np.hstack([sampled.B, sampled.A @ sampled.B])
    sizes = np.linalg.svd(controllability)[1]
    assert sizes[1] < 1e-9 * sizes[0]
    # No gain damps the mode there: one of its two poles stays.
    weights = {"state_weight": [1e3, 1.0, 0.0], "command_weight": [1e-6], "coordinates": "sine"}
    open_loop_radius = np.abs(np.linalg.eigvals(sampled.A)).max()
    moved = []
    for share in (0.5, 1.0):
        sampled = plant.discretize(share * limit)
        gain = designed_gain(LQR(**weights, period=share * limit, sampling="exact"), model)
        moved.append(
            np.abs(np.linalg.eigvals(sampled.A - sampled.B @ gain)).max() / open_loop_radius**share
        )
    assert moved[0] < 0.75
    assert moved[1] == pytest.approx(1.0, abs=1e-6)


def test_slow_sampling_warns(tmp_path, capsys):
    """In Python by a warning, on the command line by one sentence, before the run."""
    slow = beam_case(LQR(**WEIGHTS, period=5e-3, sampling="exact"))
    with pytest.warns(
        SamplingWarning,
        match="the mode at .* Hz is hardly controllable at a period of .* limit is pi",
    ):
        check_case(slow)
    with pytest.warns(SamplingWarning):
        check_case(beam_case(LQR(**WEIGHTS, period=5e-3)))
    check_case(beam_case(LQR(**WEIGHTS, period=2e-3, sampling="exact")))
    path = tmp_path / "slow.toml"
    jb.save_case(slow, path)
    with warnings.catch_warnings(), pytest.raises(SystemExit) as ended:
        warnings.simplefilter("default")
        main(["modes", str(path), "--json"])
    printed = capsys.readouterr()
    assert ended.value.code == 0 and json.loads(printed.out)
    assert printed.err.count("hardly controllable") == 1
    assert printed.err.startswith("jaxbeam: warning: the mode at ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "controller.period must be given"),
        ({"period": 1e-3, "delay": 1e-3}, "controller.delay must be less than the period"),
        ({"period": 1e-3, "input_rate_weight": [1.0, 1.0]}, "must have 1 entry, not 2"),
    ],
)
def test_errors_of_settings(options, message):
    with pytest.raises(ValueError, match=message):
        check_case(beam_case(LQR(**WEIGHTS, **options, sampling="exact")))


def test_poles_of_the_loop_are_those_of_the_design(model):
    """Eigenvalues of the transition over a period, delay and rate weight included."""
    law = LQR(**WEIGHTS, period=2e-3, delay=5e-4, input_rate_weight=[1e-8], sampling="exact")
    plant, (Q, R) = model.unloaded, law.weights(model)
    state, _ = integrate(*map(np.asarray, (plant.A, plant.B, Q, R)), (5e-4, 1.5e-3))
    transition, input_matrix = (
        np.vstack([state[:, :8], np.zeros((1, 8))]),
        np.append(state[:, 8:], [[1.0]], 0),
    )
    expected = np.abs(
        np.linalg.eigvals(transition - input_matrix @ np.asarray(designed_gain(law, model)))
    )
    found = np.abs(np.linalg.eigvals(linearised_loop(beam_case(law), 0.0).closed_matrix))
    assert_allclose(np.sort(found)[-7:], np.sort(expected)[-7:], rtol=1e-7)


# Batched designs over masses, speeds and weights, and their derivatives.

BATCH_WEIGHTS = {"state_weight": [4e5, 1e5, 10.0, 1.0, 0.0], "command_weight": [1e-3]}
GRID = {"masses": [0.2, 0.4]}
LAWS = {
    "lqr": jb.LQR(**BATCH_WEIGHTS),
    "dlqr": LQR(**BATCH_WEIGHTS, period=2e-3, sampling="exact"),
    "lqr-step": jb.LQR(**BATCH_WEIGHTS, points=4, horizon="frozen"),
    "lqr-finite": jb.LQR(**BATCH_WEIGHTS, points=60, horizon="crossing"),
    "lqr-augmented": jb.LQR(**BATCH_WEIGHTS, points=60, horizon="crossing", augmented="loads"),
    "lqr-scheduled": LQR(**BATCH_WEIGHTS, **GRID, points=60, horizon="crossing", schedule="load"),
}
# A mass, a speed, a weight of a state, one of the command, and a parameter of the plant.
ADDRESSES = (
    "loads.0.mass",
    "loads.0.speed",
    "controller.state_weight.0",
    "controller.command_weight.0",
    "beam.flexural_rigidity",
)
SIZES = np.array([0.3, 4.0, 4e5, 1e-3, 11.68])
STATE = jnp.array([1e-3, -3e-4, 0.02, 0.05, 0.1])


def batch_beam_case(law):
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.Shaker(0.22, 2000.0, 5.0, force_per_volt=4.6, bandwidth=500.0)],
        sensors=[jb.Sensor(0.25)],
        loads=[jb.MovingMass(mass=SIZES[0], speed=SIZES[1])],
        controller=law,
    )


def commands_of(name):
    """Function from relative numbers to commands for a state at three shares of the crossing."""
    case = batch_beam_case(LAWS[name])
    layout = mesh_layout(case)

    def commands(point):
        changed = jb.replace(case, dict(zip(ADDRESSES, point * SIZES, strict=True)))
        law = changed.controller.law(jb.state_space(changed, layout=layout))
        crossing_time = changed.beam.length / changed.loads[0].speed

        def command(share):
            measurement, t = Measurement(jnp.zeros(1), STATE, jnp.zeros(1)), share * crossing_time
            if changed.controller.period is None:
                return law.command(jnp.zeros(0), measurement, t)[0]
            return law.step(law.initial_state(), measurement, t).command[0]

        return jax.vmap(command)(jnp.array([0.13, 0.52, 0.97]))

    return commands


@pytest.fixture(scope="module", params=LAWS)
def design(request):
    """Commands of a design: single, and batched."""
    commands = commands_of(request.param)
    return jax.jit(commands), jax.jit(jax.vmap(commands))


def test_batched_designs_equal_single_ones(design):
    single, batched = design
    points = 1 + 0.3 * np.random.default_rng(0).uniform(-1, 1, (4, SIZES.size))
    expected = np.stack([single(point) for point in points])
    assert_allclose(batched(points), expected, rtol=1e-9)
    assert np.all(np.ptp(expected, axis=0) > 1e-3 * np.abs(expected).max(axis=0))


def test_derivatives_by_loads_weights_and_plant(design):
    single, _ = design
    at = jnp.ones(SIZES.size)
    found, expected = jax.jit(jax.jacfwd(single))(at), central(single, at, 2e-3)
    assert_allclose(found, expected, rtol=0, atol=1e-6 * np.max(np.abs(expected)))


ACTUATORS = {
    "direct": (jb.PointForce(0.22), 4),
    "lagging": (jb.Shaker(0.22, 2000.0, 5.0, force_per_volt=4.6, bandwidth=500.0), 5),
}


@pytest.mark.parametrize("varied", ["loads.0.mass", "controller.command_weight.0"])
@pytest.mark.parametrize("actuator", ACTUATORS)
def test_batched_designs_with_shared_parameters(actuator, varied):
    """Only one parameter varies; reverse-mode derivatives too."""
    part, states = ACTUATORS[actuator]
    law = jb.LQR(BATCH_WEIGHTS["state_weight"][:states], [1e-3], points=20, horizon="crossing")
    case = dataclasses.replace(batch_beam_case(law), actuators=[part])
    layout, start = mesh_layout(case), float(jb.addresses(case)[varied])

    def coefficients(share):
        changed = jb.replace(case, {varied: share * start})
        return changed.controller.crossing_gains(jb.state_space(changed, layout=layout))[
            0
        ].coefficients

    def size(share):
        return jnp.sum(coefficients(share)[:, 0] ** 2)

    shares, single = np.array([0.8, 1.0, 1.3]), jax.jit(coefficients)
    expected = np.stack([single(share) for share in shares])
    found = jax.jit(jax.vmap(coefficients))(shares)
    assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    derivatives = jax.jit(jax.vmap(jax.grad(size)))(shares)
    compiled_size = jax.jit(size)
    expected = [central(lambda x: compiled_size(x[0]), [share], step=1e-3)[0] for share in shares]
    assert_allclose(derivatives, expected, rtol=1e-6)


ESTIMATORS = {
    "kalman": (Kalman(0.02, 1e-5), 2e-3),
    "kalman, continuous": (Kalman(0.02, measurement_intensity=1e-13), None),
    "observer": (Observer(speed=2.0), 2e-3),
    "observer, continuous": (Observer(speed=2.0), None),
}


@pytest.mark.parametrize("name", ESTIMATORS)
def test_gains_of_estimators_over_the_plant(name):
    """Batched over rigidities and positions of the sensor, and their derivatives."""
    estimator, period = ESTIMATORS[name]
    case = batch_beam_case(jb.LQR(**BATCH_WEIGHTS, period=period, estimator=estimator))
    layout = mesh_layout(case)

    def gain(point):
        values = {"beam.flexural_rigidity": 11.68 * point[0], "sensors.0.position": point[1] / 4}
        changed = jb.replace(case, values)
        model = jb.state_space(changed, layout=layout)
        controller = changed.controller
        if period is None:
            filter = controller.estimator.continuous_filter(model)
        else:
            filter = controller.estimator.sampled_filter(model, sample_timing(controller))
        return filter.gain[:4, 0] / jnp.array([1.0, 1.0, 200.0, 800.0])

    single, points = jax.jit(gain), np.array([[1.0, 1.0], [0.8, 1.1], [1.3, 0.7]])
    expected = np.stack([single(point) for point in points])
    batched = jax.jit(jax.vmap(gain))(points)
    scale = np.abs(expected).max()
    assert_allclose(batched, expected, rtol=0, atol=1e-9 * scale)
    derivatives, differences = (
        jax.jit(jax.jacfwd(gain))(points[0]),
        central(single, points[0], 2e-3),
    )
    assert_allclose(derivatives, differences, rtol=0, atol=1e-6 * np.abs(differences).max())
