"""Predictive control in loops: reference runs, limits, what it knows, derivatives.

Most loops here run on a plant frozen anew in the middle of every millisecond, which compiles fast.
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
from jaxbeam.model.modes import lay_out
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


def rig(controller=None, modes=3, patch=PATCH, **run) -> jb.Case:
    """The one-span rig with a patch, and the heaviest mass at 1 m/s."""
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
    """A run sampled at its ticks, in so many steps from tick to tick."""
    times = np.arange(round(float(case.run.duration) / PERIOD) + 1) * PERIOD
    plan = IntegrationPlan(static_shapes(case), substeps, 0, False, 0.0, loop_schedule(case, times))
    return jb.simulate(case, jnp.asarray(times), plan)


# Reference runs


@pytest.fixture(scope="module")
def one_span():
    return run(rig(mpc(), modes=5), 16)


@pytest.mark.slow
def test_the_one_span_rig(one_span):
    expected = REFERENCE["one span"]
    deflection, command = 1e3 * one_span.deflection[:, 0], one_span.command[:, 0]
    # States as exact as 1e-6 of the peak are turned into commands by some 2e4 V/m.
    exact = 1e-9 * expected["peak_down_on_grid_mm"][0] * 2e4
    assert_allclose(command[:10], np.ravel(expected["u_amp_first10"]), rtol=0, atol=exact)
    assert_allclose(np.min(command), expected["u_amp_min"][0], rtol=0, atol=exact)
    at = np.round(np.array(expected["t"]) / PERIOD).astype(int)
    peak = expected["peak_down_on_grid_mm"][0]
    assert_allclose(deflection[at], np.ravel(expected["w_mm"]), rtol=0, atol=1e-6 * peak)
    assert_allclose(-np.min(deflection), peak, rtol=1e-6)


@pytest.mark.slow
def test_limits_are_kept_and_reached_as_published(one_span):
    """7.5 V from 0.05 s on; 21.5 % off the largest deflection, between 20.8 and 21.7 %."""
    command = np.asarray(one_span.command[:, 0])
    assert np.max(command) <= 7.5 and np.min(command) >= -2.5
    assert one_span.times[np.argmax(one_span.saturated[:, 0])] == 0.05
    still = REFERENCE["one span"]["peak_down_open_on_grid_mm"][0]
    reduction = 100 * (1 + 1e3 * np.min(one_span.deflection) / still)
    assert_allclose(reduction, REFERENCE["one span"]["reduction_percent"], atol=1e-3)
    assert_array_equal(one_span.failures, 0.0)


@pytest.mark.slow
def test_the_two_span_rig():
    """Within what exact modes differ by from the projected sines of the reference."""
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


# Loops on a plant frozen anew every millisecond

FINE = 10
TICKS = 62


def tabulated(case):
    """Matrices (tick, fine step, ...), push of the loads; the sensor's row; layout of the modes."""
    model = jb.state_space(case)
    middles = (jnp.arange(TICKS * FINE) + 0.5) * PERIOD / FINE

    @eqx.filter_jit
    def parts(model):
        system = jax.vmap(lambda t: model.at(t).discretize(PERIOD / FINE))(middles)
        push = system.B[:, :, 1:] @ model.weights
        every = system.A, system.B[..., :1], push
        return tuple(part.reshape(TICKS, FINE, *part.shape[1:]) for part in every)

    return *parts(model), model.unloaded.C, lay_out(case)


@pytest.fixture(scope="module")
def crossing():
    return tabulated(rig())


def closed(case, crossing):
    """Deflections and commands at the ticks, and how often no solution was found."""
    A, B, push, C, layout = crossing
    model = jb.state_space(case, layout=layout)
    controller, states = case.controller, A.shape[-1]
    limits = case.actuators[0].command_limits()

    def tick(carry, now):
        state, given, memory = carry
        t, *fine = now
        wanted, memory = controller.step(memory, Measurement(C @ state, state, given), t)
        wanted = jnp.clip(wanted, *limits)

        def onward(state, part):
            return part[0] @ state + part[1] @ wanted + part[2], None

        after, _ = jax.lax.scan(onward, state, tuple(fine))
        return (after, wanted, memory), (C @ state, wanted)

    start = jnp.zeros(states), jnp.zeros(1), controller.init(model)
    times = jnp.arange(TICKS) * PERIOD
    (*_, memory), (deflection, command) = jax.lax.scan(tick, start, (times, A, B, push))
    return deflection[:, 0], command[:, 0], controller.failures(memory)


looped = eqx.filter_jit(closed)


@pytest.fixture(scope="module")
def plain(crossing):
    return looped(rig(mpc()), crossing)


@pytest.fixture(scope="module")
def uncontrolled(crossing):
    A, _, push, C = (np.asarray(part) for part in crossing[:4])
    state, deflection = np.zeros(6), []
    for a, e in zip(A.reshape(-1, 6, 6), push.reshape(-1, 6), strict=True):
        deflection.append((C @ state).item())
        state = a @ state + e
    return np.array(deflection)[::FINE]


def test_three_modes(plain, uncontrolled):
    """20.8 % off the largest deflection with three modes, as computed independently."""
    deflection, command, failures = plain
    reduction = 100 * (1 - np.max(-deflection) / np.max(-uncontrolled))
    assert_allclose(reduction, 20.8, atol=0.1)
    assert np.max(command) <= 7.5 + 1e-9 and np.min(command) >= -2.5 - 1e-9 and failures == 0


def test_hildreth_in_the_loop(plain, crossing):
    deflection, command, failures = looped(rig(mpc(solver="hildreth")), crossing)
    assert_allclose(command, plain[1], rtol=0, atol=1e-8)
    assert_allclose(deflection, plain[0], rtol=0, atol=1e-11)
    assert failures == 0


@pytest.mark.slow
def test_knowing_the_loads_helps():
    """A light mass, for which the patch is strong enough: what is left falls to less than half."""
    light = jb.replace(rig(mpc()), {"loads.0.mass": 0.1})
    crossing = tabulated(light)
    unknown, command, _ = looped(light, crossing)
    assert np.max(command) < 7.5
    for prediction in ("time-invariant", "time-varying"):
        knowing = mpc(loads="known", prediction=prediction)
        known, *_ = looped(dataclasses.replace(light, controller=knowing), crossing)
        assert np.linalg.norm(known) < 0.5 * np.linalg.norm(unknown)
        assert np.max(np.abs(known)) < 0.8 * np.max(np.abs(unknown))


def test_rates_and_soft_limits_are_kept(crossing):
    slow = dataclasses.replace(PATCH, rate_limit=jnp.array(40.0))
    _, command, failures = looped(rig(mpc(), patch=slow), crossing)
    assert np.max(np.abs(np.diff(command, prepend=0.0))) <= 40.0 * PERIOD + 1e-9
    assert failures == 0
    # Moves are dear, and only what exceeds 0.5 mm costs much.
    easy = {"move_weight": 1e-8, "output_weight": 1e-4}
    at_will, softly = (
        looped(rig(mpc(**easy, soft_limit=limit)), crossing)[0] for limit in (1.0, 5e-4)
    )
    assert np.max(np.abs(softly)) < np.max(np.abs(at_will))
    assert np.sum(np.abs(softly) > 5.2e-4) < np.sum(np.abs(at_will) > 5.2e-4)


def test_constant_loads_leave_no_offset(crossing):
    """The beam at rest under a constant force that the controller does not know of."""
    A, B, _, *rest = crossing
    parked = tuple(jnp.broadcast_to(part[-1, -1], part.shape) for part in (A, B))
    push = jnp.broadcast_to(B[-1, -1, :, 0] * -3.0, (*A.shape[:2], 6))
    deflection, command, _ = looped(rig(mpc()), (*parked, push, *rest))
    assert np.max(np.abs(deflection)) > 1e-5
    assert_allclose(deflection[-1], 0.0, atol=1e-9)
    assert_allclose(command[-1], 3.0, rtol=1e-5)


@pytest.mark.slow
def test_records_count_steps_without_a_solution():
    stuck = dataclasses.replace(PATCH, limits=jnp.array([1.0, 2.0]), rate_limit=jnp.array(10.0))
    record = run(rig(mpc(), modes=1, patch=stuck, duration=0.05), 1)
    assert_array_equal(record.failures, np.arange(1, 7))
    assert_array_equal(record.command, 1.0)  # what is held, 0 V, within the limits
    assert "no solution in 6 of its steps" in record.verdict
    assert record.to_xarray().failures.dims == ("time",)


@pytest.mark.slow
def test_sweeps_count_steps_without_a_solution():
    """At 1000 V/s the limits are reached in a period, at 10 V/s they never are."""
    stuck = dataclasses.replace(PATCH, limits=jnp.array([1.0, 2.0]), rate_limit=jnp.array(10.0))
    case = rig(mpc(), modes=1, patch=stuck, duration=0.05)
    runs = jb.sweep(case, {"actuators.0.rate_limit": [10.0, 1000.0]}, progress=False)
    assert_array_equal(runs.controller_failures, [6.0, 0.0])
    assert not runs.failed.any()


@pytest.mark.slow
def test_derivatives_of_a_closed_loop(crossing):
    """By r_w and the weights of the horizon, forward and in reverse; limits are felt throughout."""

    def cost(change):
        weights = {"move_weight": 1e-8 * jnp.exp(change[0]), "horizon_weight": jnp.exp(change[1:])}
        deflection, command, _ = closed(rig(mpc(horizon=3, moves=2, **weights)), crossing)
        total = jnp.sum(deflection**2) * 1e6 + jnp.sum(command**2) * 1e-3
        return jnp.stack([total, jnp.max(command)])

    point = jnp.zeros(4)
    assert_allclose(jax.jit(cost)(point)[1], 7.5, rtol=1e-9)
    expected = central(jax.jit(cost), point, 1e-4, order=4)
    size = np.max(np.abs(expected))
    assert size > 1e-3
    for derivative in (jax.jacfwd, jax.jacrev):
        assert_allclose(jax.jit(derivative(cost))(point), expected, rtol=0, atol=1e-6 * size)
