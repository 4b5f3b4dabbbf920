"""Quadratic programs against qpax: equal solutions, and its flags for infeasible problems."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import qpax
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.numerics.qp import solve_qp
from tests.control.predictive.test_mpc import beam_case, mpc
from tests.control.predictive.test_mpc_law import commands
from tests.control.predictive.test_qp import FEASIBLE, problems
from tests.oracles import qpax_solver


@pytest.fixture(scope="module")
def solve_by_qpax():
    return jax.jit(jax.vmap(qpax_solver.solve))


@pytest.mark.parametrize("kind", FEASIBLE)
def test_solutions_agree_to_1e_8(kind, solve_by_qpax):
    """Where qpax converges: not for one in twenty of the vertices with a zero multiplier."""
    given = problems(kind, 6, 12)
    own = jax.jit(jax.vmap(solve_qp))(*given)
    x, solved = solve_by_qpax(*given)
    assert np.mean(solved) > (0.9 if kind == "all rows active" else 0.99)
    assert_allclose(x[solved], own.x[solved], rtol=0, atol=1e-8)


def test_infeasible_problems_are_never_called_solved(solve_by_qpax):
    assert not np.any(solve_by_qpax(*problems("infeasible", 6, 12))[1])


def test_default_algorithm_calls_infeasible_problems_converged():
    """In batches; hence the oracle confirms its flag."""

    def by_default(H, f, M, gamma):
        x, _, _, _, converged, _ = qpax.solve_qp(H, f, jnp.zeros((0, 6)), jnp.zeros(0), M, gamma)
        return x, converged

    x, converged = jax.jit(jax.vmap(by_default))(*problems("infeasible", 6, 12, count=200))
    assert_array_equal(converged, 1)
    assert np.all(np.any(np.isnan(x), axis=1))


def test_commands_of_predictive_control():
    """Each command is the one before plus the first move of the program, solved by qpax."""
    states = jnp.asarray(np.random.default_rng(3).normal(size=(12, 6))) * 1e-3
    controller = mpc()
    found = np.asarray(commands(controller, states))
    assert np.any(np.isclose(found, 7.5))

    @jax.jit
    def next_command(plant, state, last_state, previous):
        law = controller.law(plant).law
        predicted = law.sampled_plant.A @ last_state + law.sampled_plant.B @ previous
        initial = jnp.concatenate([state, state - predicted, previous, jnp.ones(1)])
        x, solved = qpax_solver.solve(*law.quadratic_program(law.prediction, initial, previous))
        return previous + law.move_maps[0] @ x, solved

    plant = jb.state_space(beam_case(controller))
    last_state, previous = jnp.zeros(6), jnp.zeros(1)
    for state, command in zip(states, found, strict=True):
        expected, solved = next_command(plant, state, last_state, previous)
        assert solved
        assert_allclose(command, expected, rtol=0, atol=1e-8)
        last_state, previous = state, jnp.asarray(command)
