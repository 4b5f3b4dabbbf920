"""Linear-quadratic regulators: gains and loops against independent ones, cost, optimality."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from jaxbeam.control.design_model import DesignModel
from jaxbeam.control.optimal.lqr import LQR
from tests.modules import DATA

REFERENCE = json.loads((DATA / "optimal_control.json").read_text())
SHARES = np.array(REFERENCE["fractions_of_crossing"])
WEIGHTS = {
    "state_weight": REFERENCE["case"]["Q"],
    "command_weight": [REFERENCE["case"]["R"]],
    "coordinates": "sine",
}
PARTIAL_FEEDBACK = [1, 1, 0, 1, 0, 0, 0]  # q1, q2 and the rate of q1 are fed back
DESIGN = DesignModel(force_per_volt=4.6)
# Deflections (m) of the loop with the finite-horizon gain, 0.055 and 0.273 s after the exit: P and
# loop by scipy's Radau to 1e-10 (the same to 1e-11), P as its dense output, on the same A(t), B(t).
AFTER_EXIT = [4.737544e-07, 7.254085e-11]


def beam_case(controller=None, force_per_volt=4.6, **run):
    shaker = jb.Shaker(0.5, 12000.0, 80.0, force_per_volt=force_per_volt, bandwidth=1e4)
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=3),
        actuators=[shaker],
        sensors=[jb.Sensor(0.25)],
        loads=[jb.MovingMass(mass=0.509, speed=0.55)],
        controller=controller,
        run=jb.Run(**({"duration": 1.4, "sample_rate": 200.0} | run)),
    )


@pytest.fixture(scope="module")
def model():
    return jb.state_space(beam_case(), "sine")


def gains_at(regulator, model, shares=SHARES):
    return eqx.filter_jit(lambda m: jax.vmap(regulator.gain_table(m))(jnp.asarray(shares)))(model)


def test_time_invariant_gain(model):
    gain = LQR(**WEIGHTS).time_invariant_gain(model)
    assert_allclose(gain[0], REFERENCE["time_invariant_gain"], rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "points", "name"),
    [
        ({"horizon": "frozen"}, 200, "step_by_step_gains"),
        ({"horizon": "crossing"}, 1200, "finite_time_gains"),
        ({"horizon": "crossing", "augmented": "loads"}, 1200, "augmented_finite_time_gains"),
    ],
)
def test_gains_over_the_crossing(model, options, points, name):
    gains = gains_at(LQR(**WEIGHTS, **options, points=points), model)[:, 0]
    assert_allclose(gains, REFERENCE[name], rtol=1e-6)


@pytest.mark.parametrize(
    ("controller", "name"),
    [
        (LQR(**WEIGHTS, feedback=PARTIAL_FEEDBACK, design=DESIGN), "time_invariant"),
        (
            LQR(**WEIGHTS, feedback=PARTIAL_FEEDBACK, design=DESIGN, horizon="crossing"),
            "finite_time",
        ),
        (
            LQR(
                **WEIGHTS,
                feedback=PARTIAL_FEEDBACK,
                design=DESIGN,
                horizon="crossing",
                augmented="loads",
            ),
            "augmented",
        ),
    ],
)
def test_closed_loops(controller, name):
    """Against scipy; the motion after the exit depends on a boundary layer of 0.1 ms in the gain.

    The reference does not resolve that layer: it is replaced by `AFTER_EXIT`, or left out.
    """
    expected = REFERENCE[f"continuous_closed_loop_{name}"]
    record = jb.simulate(beam_case(controller, 2.5), times=jnp.array([0.0, *expected["time_s"]]))
    last = 5 if name == "augmented" else None
    deflection = np.array(expected["deflection_at_0p25_m"])
    if name == "finite_time":
        deflection[5:] = AFTER_EXIT
    peak, largest_voltage = np.max(np.abs(deflection)), np.max(np.abs(expected["voltage"]))
    found, command = record.deflection[1:, 0][:last], record.command[1:, 0][:last]
    assert_allclose(found, deflection[:last], rtol=0, atol=1e-6 * peak)
    assert_allclose(command, expected["voltage"][:last], rtol=0, atol=1e-6 * largest_voltage)


def test_cost_of_the_optimal_gain(model):
    """z0' P z0 is the cost of the run from z0, and no change of the gains lowers it."""
    regulator = LQR(**WEIGHTS, points=400, horizon="crossing")
    Q, R = regulator.weights(model)
    start = jnp.array([1e-3, -2e-4, 1e-4, 0.02, 0.01, -0.03, 0.3])
    table, costs = eqx.filter_jit(lambda m: regulator.crossing_gains(m))(model)
    end = 0.6 / 0.55
    times = jnp.linspace(0.0, end, 40001)  # a lag of 0.1 ms, by the Runge-Kutta method
    step = times[1]
    perturbation = jnp.asarray(np.random.default_rng(0).normal(size=(2, 7))) * table(
        jnp.ones(()) / 2
    )

    @jax.jit
    def cost(change):
        def rate(t, state):
            share = t / end
            gain = table(share) + change[0] * perturbation[0] + change[1] * share * perturbation[1]
            command, system = -gain @ state[:7], model.at(jnp.minimum(t, end - 1e-9))
            cost_rate = state[:7] @ Q @ state[:7] + command @ R @ command
            return jnp.append(system.A @ state[:7] + system.B[:, :1] @ command, cost_rate)

        def advance(state, t):
            a = rate(t, state)
            b = rate(t + step / 2, state + step / 2 * a)
            c = rate(t + step / 2, state + step / 2 * b)
            d = rate(t + step, state + step * c)
            return state + step / 6 * (a + 2 * b + 2 * c + d), None

        last, _ = jax.lax.scan(advance, jnp.append(start, 0.0), times[:-1])
        return last[7] + last[:7] @ Q @ last[:7]

    predicted = start @ costs[0] @ start
    assert_allclose(cost(jnp.zeros(2)), predicted, rtol=1e-6)
    slope, second_difference = (
        jax.jit(jax.jacfwd(cost))(jnp.zeros(2)),
        cost(jnp.ones(2)) - predicted,
    )
    assert second_difference > 1e-3 * predicted
    assert_allclose(slope, 0.0, atol=1e-6 * predicted)


def test_intervals_needed_follow_from_the_modes_of_the_design():
    few = DesignModel(modes=1)
    check_case(beam_case(LQR([1.0] * 3, [1.0], points=100, design=few, horizon="crossing")))


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        (LQR([1.0] * 6, [1.0]), "state_weight must have 7 entries, not 6"),
        (LQR([1.0] * 7, [0.0]), "command_weight.0 must be positive"),
        (LQR([-1.0] * 7, [1.0]), "state_weight.0 must not be negative"),
        (LQR([1.0] * 7, [1.0, 1.0]), "command_weight must have 1 entries"),
        (LQR([1.0] * 7, [1.0], positions=[0.3]), "positions and position_weight belong"),
        (
            LQR([1.0] * 7, [1.0], positions=[0.9], position_weight=[1.0]),
            "positions must lie on the beam",
        ),
        (
            LQR([1.0] * 7, [1.0], design=DesignModel(correction=0.3)),
            "design.correction has no effect",
        ),
        (LQR([1.0] * 7, [1.0], points=100, horizon="crossing"), "points must be at least"),
        (LQR([1.0] * 7, [1.0], points=100), "points has no effect with horizon = 'infinite'"),
        (
            LQR([1.0] * 7, [1.0], horizon="frozen", augmented="loads"),
            "augmented has no effect with horizon = 'frozen': leave it out, or take horizon = 'cro",
        ),
        (LQR([1.0] * 7, [1.0], input_rate_weight=[1.0]), "input_rate_weight has no effect with"),
        (
            LQR([1.0] * 7, [1.0], horizon="crossing", schedule="load"),
            "masses must be given with schedule = 'load'",
        ),
    ],
)
def test_errors_of_settings(controller, message):
    with pytest.raises(ValueError, match=message):
        check_case(beam_case(controller))
