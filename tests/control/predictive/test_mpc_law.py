"""Law of predictive control against its formulas; settings in case files."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.predictive.prediction import incremental_model
from jaxbeam.numerics.riccati import dlqr
from tests.control.predictive.test_mpc import PATCH, PERIOD, beam_case, mpc


def test_complete_laguerre_basis_equals_plain_moves():
    states = jnp.asarray(np.random.default_rng(0).normal(size=(3, 6))) * 1e-3
    plain, laguerre = (
        commands(mpc(horizon=4, laguerre_pole=pole, solver="unconstrained"), states)
        for pole in (None, 0.5)
    )
    assert_allclose(laguerre, plain, rtol=1e-6)


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


def test_unconstrained_law():
    """Eq. (7.9) of the thesis, with weights."""
    output_weight, horizon_weight = 3.0, np.linspace(1.0, 2.0, 6)
    controller = mpc(
        output_weight=output_weight, horizon_weight=horizon_weight, solver="unconstrained"
    )
    states = np.random.default_rng(0).normal(size=(2, 6)) * 1e-3
    A, B, C = map(np.asarray, incremental_model(*incremental_plant(beam_case(controller))))
    power = [np.linalg.matrix_power(A, n) for n in range(7)]
    F = np.concatenate([C @ power[n] for n in range(1, 7)])
    Phi = np.array(
        [[(C @ power[i - j] @ B).item() if i >= j else 0 for j in range(4)] for i in range(6)]
    )
    weight = np.diag(output_weight * horizon_weight)
    gain = np.linalg.solve(Phi.T @ weight @ Phi + 1e-11 * np.eye(4), Phi.T @ weight @ F)[0]
    expected, previous = 0.0, np.zeros(6)
    C = incremental_plant(beam_case(controller))[2]
    for state, command in zip(states, commands(controller, jnp.asarray(states)), strict=True):
        expected = expected - gain @ np.concatenate([state - previous, C @ state])
        assert_allclose(command, [expected], rtol=1e-9)
        previous = state


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
        ({"move_weight": [1.0, 1.0]}, "move_weight must have one number or 1 entries, not 2"),
        ({"output_weight": [1.0, 1.0]}, "output_weight must have one number or 1 entries, not 2"),
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
