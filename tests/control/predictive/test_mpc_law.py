"""The law of predictive control by its formulas; its settings in case files."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check
from jaxbeam.control.predictive.prediction import incremental_model
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.numerics.riccati import dlqr
from tests.control.predictive.test_mpc import PATCH, PERIOD, mpc, rig


def test_laguerre_moves_that_span_all_moves_change_nothing():
    states = jnp.asarray(np.random.default_rng(0).normal(size=(3, 6))) * 1e-3
    plain, spun = (
        commands(mpc(horizon=4, laguerre_pole=pole, solver="unconstrained"), states)
        for pole in (None, 0.5)
    )
    assert_allclose(spun, plain, rtol=1e-6)


def commands(controller, states, patch=PATCH, failing=False):
    """What a controller wants at successive ticks in given states; it is given all it wants."""
    case = rig(controller, patch=patch)
    model = jb.state_space(case)

    @eqx.filter_jit
    def asked(controller, model):
        def tick(carry, state):
            given, memory, t = carry
            given, memory = controller.step(memory, Measurement(jnp.zeros(1), state, given), t)
            return (given, memory, t + PERIOD), (given, controller.failures(memory))

        start = jnp.zeros(1), controller.init(model), jnp.zeros(())
        return jax.lax.scan(tick, start, states)[1]

    wanted, failures = asked(controller, model)
    return (wanted, failures) if failing else wanted


def incremental_plant(case):
    model = jb.state_space(case)
    system = model.unloaded.discretize(PERIOD)
    return system.A, system.B, system.C


def test_the_unconstrained_law():
    """Eq. (7.9), with weights, by its formula."""
    output, ahead = 3.0, np.linspace(1.0, 2.0, 6)
    controller = mpc(output_weight=output, horizon_weight=ahead, solver="unconstrained")
    states = np.random.default_rng(0).normal(size=(2, 6)) * 1e-3
    wide, push, seen = map(np.asarray, incremental_model(*incremental_plant(rig(controller))))
    power = [np.linalg.matrix_power(wide, n) for n in range(7)]
    F = np.concatenate([seen @ power[n] for n in range(1, 7)])
    Phi = np.array(
        [[(seen @ power[i - j] @ push).item() if i >= j else 0 for j in range(4)] for i in range(6)]
    )
    weight = np.diag(output * ahead)
    gain = np.linalg.solve(Phi.T @ weight @ Phi + 1e-11 * np.eye(4), Phi.T @ weight @ F)[0]
    given, before = 0.0, np.zeros(6)
    C = incremental_plant(rig(controller))[2]
    for state, command in zip(states, commands(controller, jnp.asarray(states)), strict=True):
        given = given - gain @ np.concatenate([state - before, C @ state])
        assert_allclose(command, [given], rtol=1e-9)
        before = state


def test_the_terminal_cost_makes_it_the_regulator():
    """Dual mode, eq. (7.31): with it at any horizon, and without at a long one."""
    states = np.random.default_rng(0).normal(size=(2, 6)) * 1e-3
    A, B, C = incremental_plant(rig())
    wide, push, seen = incremental_model(A, B, C)
    gain = dlqr(wide, push, seen.T @ seen, 1e-11 * jnp.eye(1))[0]
    first = -gain @ np.concatenate([states[0], C @ states[0]])
    second = first - gain @ np.concatenate([states[1] - states[0], C @ states[1]])
    expected = np.stack([first, second])
    dual = mpc(horizon=4, terminal="riccati", solver="unconstrained")
    assert_allclose(commands(dual, jnp.asarray(states)), expected, rtol=1e-6)
    far = mpc(horizon=60, moves=60, solver="unconstrained")
    assert_allclose(commands(far, jnp.asarray(states)), expected, rtol=1e-6)


def test_no_solution_holds_the_last_command_and_is_counted():
    """From 0 V, 1 V cannot be reached as fast as the limits ask."""
    stuck = dataclasses.replace(PATCH, limits=jnp.array([1.0, 2.0]), rate_limit=jnp.array(10.0))
    wanted, failures = commands(mpc(), jnp.zeros((2, 6)), stuck, failing=True)
    assert_array_equal(wanted, 0.0)
    assert_array_equal(failures, [1.0, 2.0])
    case = rig(mpc(), patch=stuck)
    seen = Measurement(jnp.zeros(1), 1e-3 * jnp.ones(6), jnp.array([0.7]))  # 0.3 V from the limits
    memory = case.controller.init(jb.state_space(case))
    command, memory = eqx.filter_jit(case.controller.step)(memory, seen, jnp.zeros(()))
    assert_array_equal(command, 0.7)
    assert case.controller.failures(memory) == 1


def test_case_files_hold_it():
    case = rig(mpc(places=[0.2, 0.4], soft_limit=1e-3, loads="known", delay=0.002))
    check(case)
    assert eqx.tree_equal(case, case_from_dict(case_to_dict(case)))


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
        ({"places": []}, "places must be given"),
        ({"places": [0.1, 0.5], "terminal": "riccati"}, "terminal must be 'none': 1 actuators"),
        ({"solver": "simplex"}, "solver"),
    ],
)
def test_faulty_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        check(rig(mpc(**settings)))
