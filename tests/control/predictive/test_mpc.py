"""Closed loops with predictive control: reference runs, limits, derivatives.

Most loops use the plant frozen in the middle of each millisecond, which compiles fast.
"""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.prediction import incremental_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.numerics.riccati import dlqr
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes
from tests.differences import central
from tests.modules import DATA

REFERENCE = json.loads((DATA / "predictive_control.json").read_text())
PERIOD = 0.01
PATCH = jb.Patch(
    0.2575, 0.3425, 8.292438504838157e-4, correction=0.32, amplifier_gain=200.0, limits=[-2.5, 7.5]
)
THESIS = {"horizon": 6, "moves": 4, "move_weight": 1e-11, "period": PERIOD}


def beam_case(controller=None, modes=3, patch=PATCH, **run) -> jb.Case:
    """One-span rig with a patch, and the heaviest mass at 1 m/s."""
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, 0.03, modes=modes),
        actuators=[patch],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.509, speed=1.0)],
        controller=controller,
        run=jb.Run(**({"duration": 0.8, "sample_rate": 100.0} | run)),
    )


def mpc(**settings) -> jb.MPC:
    return jb.MPC(**(THESIS | settings))


def run(case: jb.Case, substeps: int) -> jb.Record:
    """Run saved at the samples of the controller, with some integration steps in each period."""
    times = np.arange(round(float(case.run.duration) / PERIOD) + 1) * PERIOD
    plan = IntegrationPlan(static_shapes(case), substeps, 0, False, 0.0, loop_schedule(case, times))
    return jb.simulate(case, jnp.asarray(times), plan)


# Reference runs


@pytest.fixture(scope="module")
def one_span():
    return run(beam_case(mpc(), modes=5), 16)


def test_one_span_rig(one_span):
    expected = REFERENCE["one span"]
    deflection, command = 1e3 * one_span.deflection[:, 0], one_span.command[:, 0]
    # Errors of 1e-6 of the peak, multiplied by a gain of about 2e4 V/m.
    tolerance = 1e-9 * expected["peak_down_on_grid_mm"][0] * 2e4
    assert_allclose(command[:10], np.ravel(expected["u_amp_first10"]), rtol=0, atol=tolerance)
    assert_allclose(np.min(command), expected["u_amp_min"][0], rtol=0, atol=tolerance)
    at = np.round(np.array(expected["t"]) / PERIOD).astype(int)
    peak = expected["peak_down_on_grid_mm"][0]
    assert_allclose(deflection[at], np.ravel(expected["w_mm"]), rtol=0, atol=1e-6 * peak)
    assert_allclose(-np.min(deflection), peak, rtol=1e-6)


def test_limits_and_reduction_as_published(one_span):
    """7.5 V from 0.05 s on; the peak is reduced by 21.5 %, between 20.8 and 21.7 %."""
    command = np.asarray(one_span.command[:, 0])
    assert np.max(command) <= 7.5 and np.min(command) >= -2.5
    assert one_span.times[np.argmax(one_span.saturated[:, 0])] == 0.05
    uncontrolled = REFERENCE["one span"]["peak_down_open_on_grid_mm"][0]
    reduction = 100 * (1 + 1e3 * np.min(one_span.deflection) / uncontrolled)
    assert_allclose(reduction, REFERENCE["one span"]["reduction_percent"], atol=1e-3)
    assert_array_equal(one_span.failures, 0.0)


def test_two_span_rig():
    """Within the difference of exact modes from the projected sines of the reference."""
    expected = REFERENCE["two spans"]
    patches = [
        dataclasses.replace(PATCH, start=x, end=x + 0.085, correction=jnp.array(0.39))
        for x in (jnp.array(0.2575), jnp.array(0.8575))
    ]
    case = jb.Case(
        jb.Beam(1.2, 12.11, 0.5411, 0.03, modes=7),
        [jb.Support(0.6)],
        patches,
        [jb.Sensor(0.3), jb.Sensor(0.9)],
        [jb.MovingMass(mass=0.509, speed=1.0)],
        mpc(horizon=4, moves=3),
        jb.Run(1.2, sample_rate=100.0),
    )
    record = run(case, 16)
    peaks = 1 + 1e3 * np.min(record.deflection, axis=0) / np.array(
        expected["peak_down_open_on_grid_mm"]
    )
    assert_allclose(100 * peaks, expected["reduction_percent"], atol=0.3)
    assert_allclose(record.command[:10], expected["u_amp_first10"], rtol=0, atol=0.1)


# Loops on a plant frozen in each millisecond

SUBSTEPS = 10
SAMPLES = 62


def crossing_matrices(case):
    """A, B and input by the loads (sample, substep, ...), C of the sensor, layout of the modes."""
    model = jb.state_space(case)
    midpoints = (jnp.arange(SAMPLES * SUBSTEPS) + 0.5) * PERIOD / SUBSTEPS

    @eqx.filter_jit
    def parts(model):
        system = jax.vmap(lambda t: model.at(t).discretize(PERIOD / SUBSTEPS))(midpoints)
        load_input = system.B[:, :, 1:] @ model.weights
        matrices = system.A, system.B[..., :1], load_input
        return tuple(part.reshape(SAMPLES, SUBSTEPS, *part.shape[1:]) for part in matrices)

    return *parts(model), model.unloaded.C, mesh_layout(case)


@pytest.fixture(scope="module")
def crossing():
    return crossing_matrices(beam_case())


def close_loop(case, crossing):
    """Deflections and commands at the samples, and number of samples without a solution."""
    A, B, load_input, C, layout = crossing
    law = case.controller.law(jb.state_space(case, layout=layout))
    limits = case.actuators[0].command_limits()

    def period(carry, sample):
        state, command, law_state, failures = carry
        t, *matrices = sample
        measurement = Measurement(C @ state, state, command)
        command, law_state, solved = law.step(law_state, measurement, t)
        command = jnp.clip(command, *limits)

        def substep(state, part):
            return part[0] @ state + part[1] @ command + part[2], None

        after, _ = jax.lax.scan(substep, state, tuple(matrices))
        return (after, command, law_state, failures + ~solved), (C @ state, command)

    start = jnp.zeros(A.shape[-1]), jnp.zeros(1), law.initial_state(), jnp.zeros(())
    samples = jnp.arange(SAMPLES) * PERIOD, A, B, load_input
    (*_, failures), (deflection, command) = jax.lax.scan(period, start, samples)
    return deflection[:, 0], command[:, 0], failures


compiled_loop = eqx.filter_jit(close_loop)


@pytest.fixture(scope="module")
def controlled(crossing):
    return compiled_loop(beam_case(mpc()), crossing)


@pytest.fixture(scope="module")
def uncontrolled(crossing):
    A, _, load_input, C = (np.asarray(part) for part in crossing[:4])
    state, deflection = np.zeros(6), []
    for a, e in zip(A.reshape(-1, 6, 6), load_input.reshape(-1, 6), strict=True):
        deflection.append((C @ state).item())
        state = a @ state + e
    return np.array(deflection)[::SUBSTEPS]


def test_three_modes(controlled, uncontrolled):
    """The peak is reduced by 20.8 % with three modes, as computed independently."""
    deflection, command, failures = controlled
    reduction = 100 * (1 - np.max(-deflection) / np.max(-uncontrolled))
    assert_allclose(reduction, 20.8, atol=0.1)
    assert np.max(command) <= 7.5 + 1e-9 and np.min(command) >= -2.5 - 1e-9 and failures == 0


def test_hildreth_in_the_loop(controlled, crossing):
    deflection, command, failures = compiled_loop(beam_case(mpc(solver="hildreth")), crossing)
    assert_allclose(command, controlled[1], rtol=0, atol=1e-8)
    assert_allclose(deflection, controlled[0], rtol=0, atol=1e-11)
    assert failures == 0


def test_no_steady_deflection_under_an_unknown_constant_load(crossing):
    """The commands balance a constant force, and the beam comes to rest at zero."""
    A, B, _, *rest = crossing
    frozen = tuple(jnp.broadcast_to(part[-1, -1], part.shape) for part in (A, B))
    load_input = jnp.broadcast_to(B[-1, -1, :, 0] * -3.0, (*A.shape[:2], 6))
    deflection, command, _ = compiled_loop(beam_case(mpc()), (*frozen, load_input, *rest))
    assert np.max(np.abs(deflection)) > 1e-5
    assert_allclose(deflection[-1], 0.0, atol=1e-9)
    assert_allclose(command[-1], 3.0, rtol=1e-5)


def test_records_count_steps_without_a_solution():
    infeasible = dataclasses.replace(
        PATCH, limits=jnp.array([1.0, 2.0]), rate_limit=jnp.array(10.0)
    )
    record = run(beam_case(mpc(), modes=1, patch=infeasible, duration=0.05), 1)
    assert_array_equal(record.failures, np.arange(1, 7))
    assert_array_equal(record.command, 1.0)  # 0 V is held, clipped to the limits
    assert "no solution in 6 of its steps" in record.verdict
    assert record.to_xarray().failures.dims == ("time",)


def test_sweeps_count_steps_without_a_solution():
    """At 1000 V/s the limits are reached within a period, at 10 V/s never."""
    infeasible = dataclasses.replace(
        PATCH, limits=jnp.array([1.0, 2.0]), rate_limit=jnp.array(10.0)
    )
    case = beam_case(mpc(), modes=1, patch=infeasible, duration=0.05)
    runs = jb.sweep(case, {"actuators.0.rate_limit": [10.0, 1000.0]}, progress=False)
    assert_array_equal(runs.controller_failures, [6.0, 0.0])
    assert not runs.failed.any()


def test_derivatives_of_a_closed_loop(crossing):
    """By r_w and the weights of the horizon, forward and reverse; limits are active throughout."""

    def cost(change):
        weights = {"move_weight": 1e-8 * jnp.exp(change[0]), "horizon_weight": jnp.exp(change[1:])}
        deflection, command, _ = close_loop(beam_case(mpc(horizon=3, moves=2, **weights)), crossing)
        total = jnp.sum(deflection**2) * 1e6 + jnp.sum(command**2) * 1e-3
        return jnp.stack([total, jnp.max(command)])

    point = jnp.zeros(4)
    assert_allclose(jax.jit(cost)(point)[1], 7.5, rtol=1e-9)
    expected = central(jax.jit(cost), point, 1e-4, order=4)
    size = np.max(np.abs(expected))
    assert size > 1e-3
    for derivative in (jax.jacfwd, jax.jacrev):
        assert_allclose(jax.jit(derivative(cost))(point), expected, rtol=0, atol=1e-6 * size)


# Law of predictive control against its formulas; settings in case files.


def commands(controller, states, patch=PATCH, failing=False):
    """Commands at successive samples in given states, applied without limits of the actuators.

    With `failing` also the number of samples without a solution, up to each sample.
    """
    case = beam_case(controller, patch=patch)
    model = jb.state_space(case)

    @eqx.filter_jit
    def run(controller, model):
        law = controller.law(model)

        def step(carry, state):
            command, law_state, failures, t = carry
            measurement = Measurement(jnp.zeros(1), state, command)
            command, law_state, solved = law.step(law_state, measurement, t)
            failures = failures + ~solved
            return (command, law_state, failures, t + PERIOD), (command, failures)

        start = jnp.zeros(1), law.initial_state(), jnp.zeros(()), jnp.zeros(())
        return jax.lax.scan(step, start, states)[1]

    found, failures = run(controller, model)
    return (found, failures) if failing else found


def incremental_plant(case):
    model = jb.state_space(case)
    system = model.unloaded.discretize(PERIOD)
    return system.A, system.B, system.C


def test_terminal_cost_gives_the_regulator():
    """Dual mode, eq. (7.31): with terminal cost at any horizon, without it at a long one."""
    states = np.random.default_rng(0).normal(size=(2, 6)) * 1e-3
    A, B, C = incremental_plant(beam_case())
    A, B, rows = incremental_model(A, B, C)
    gain = dlqr(A, B, rows.T @ rows, 1e-11 * jnp.eye(1))[0]
    first = -gain @ np.concatenate([states[0], C @ states[0]])
    second = first - gain @ np.concatenate([states[1] - states[0], C @ states[1]])
    expected = np.stack([first, second])
    dual = mpc(horizon=4, terminal="riccati", solver="unconstrained")
    assert_allclose(commands(dual, jnp.asarray(states)), expected, rtol=1e-6)
    long = mpc(horizon=60, moves=60, solver="unconstrained")
    assert_allclose(commands(long, jnp.asarray(states)), expected, rtol=1e-6)


def test_without_a_solution_the_last_command_is_held():
    """Lower limit 1 V, which the rate limit does not allow to be reached from 0 V."""
    infeasible = dataclasses.replace(
        PATCH, limits=jnp.array([1.0, 2.0]), rate_limit=jnp.array(10.0)
    )
    found, failures = commands(mpc(), jnp.zeros((2, 6)), infeasible, failing=True)
    assert_array_equal(found, 0.0)
    assert_array_equal(failures, [1.0, 2.0])
    case = beam_case(mpc(), patch=infeasible)
    state, near_limit = 1e-3 * jnp.ones(6), jnp.array([0.7])  # V
    measurement = Measurement(jnp.zeros(1), state, near_limit)
    law = case.controller.law(jb.state_space(case))
    step = eqx.filter_jit(law.step)(law.initial_state(), measurement, jnp.zeros(()))
    assert_array_equal(step.command, 0.7)
    assert not step.solved


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"period": None}, "period must be given"),
        ({"delay": 0.01}, "delay must be less than the period"),
        ({"moves": 7}, "moves must be at most the horizon, 6, not 7"),
        ({"move_weight": [1.0, 1.0]}, "move_weight must have one number or 1 entry, not 2"),
        ({"output_weight": [1.0, 1.0]}, "output_weight must have one number or 1 entry, not 2"),
        ({"horizon_weight": [1.0]}, "horizon_weight must have 6 entries, not 1"),
        ({"move_weight": 0.0}, "move_weight must be positive"),
        ({"laguerre_pole": 1.0}, "laguerre_pole must be below 1"),
        ({"positions": []}, "positions must be given"),
        (
            {"positions": [0.1, 0.5], "terminal": "riccati"},
            "terminal must be 'none' or 'dual-mode': 1",
        ),
        ({"solver": "simplex"}, "solver"),
        ({"solver": "qpax"}, "solver cannot be 'qpax'"),
    ],
)
def test_errors_of_settings(settings, words):
    with pytest.raises(ValueError, match=words):
        check_case(beam_case(mpc(**settings)))
