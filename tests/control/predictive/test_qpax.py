"""Quadratic programs by qpax beside our own methods: the same solutions, and honest verdicts."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxbeam.case.validation import check
from jaxbeam.control.predictive import by_qpax
from jaxbeam.control.predictive.qp import SOLVED, UNFINISHED, solve_qp
from tests.control.predictive.test_mpc import mpc, rig
from tests.control.predictive.test_qp import FEASIBLE, problems
from tests.differences import central

there = pytest.mark.skipif(not by_qpax.is_installed(), reason="qpax is not installed")


@pytest.fixture(scope="module")
def solve():
    def many(method):
        return jax.jit(jax.vmap(lambda *given: solve_qp(*given, method)))

    return {method: many(method) for method in ("interior", "qpax")}


@there
@pytest.mark.parametrize("kind", FEASIBLE)
def test_solutions_are_identical_to_1e_8(kind, solve):
    """Where it converges: not in one in twenty of the vertices without a multiplier."""
    given = problems(kind, 6, 12)
    own, other = (solve[method](*given) for method in ("interior", "qpax"))
    settled = np.asarray(other.solved)
    assert np.mean(settled) > (0.9 if kind == "all rows active" else 0.99)
    assert_array_equal(np.asarray(other.verdict)[~settled], UNFINISHED)
    assert_allclose(other.x[settled], own.x[settled], rtol=0, atol=1e-8)


@there
def test_infeasible_problems_are_never_called_solved(solve):
    assert_array_equal(solve["qpax"](*problems("infeasible", 6, 12)).verdict, UNFINISHED)


@there
def test_its_flag_alone_would_not_do():
    """Why it is checked: its default algorithm calls the infeasible converged, in batches."""
    qpax = importlib.import_module("qpax")

    def by_default(H, f, M, gamma):
        x, _, _, _, converged, _ = qpax.solve_qp(H, f, jnp.zeros((0, 6)), jnp.zeros(0), M, gamma)
        return x, converged

    x, converged = jax.jit(jax.vmap(by_default))(*problems("infeasible", 6, 12, count=200))
    assert_array_equal(converged, 1)
    assert np.all(np.any(np.isnan(x), axis=1))


@there
def test_limits_that_are_not_felt_cost_nothing():
    found = solve_qp(2 * jnp.eye(2), jnp.array([1.0, -1.0]), jnp.eye(2), jnp.ones(2), "qpax")
    assert_allclose(found.x, [-0.5, 0.5], rtol=1e-15)
    assert found.status == SOLVED and found.steps == 0


@there
def test_derivatives():
    """Forward, which qpax itself refuses, and in reverse; those of the solution, not of steps."""
    H, f, M, gamma = (part[5] for part in problems("plain", 3, 8))

    @jax.jit
    def solution(change):
        found = solve_qp(H, f + change, M, gamma + 0.1 * change[0], "qpax")
        return jnp.concatenate([found.x, found.multipliers])

    expected = central(solution, np.zeros(3), 1e-4)
    for derivative in (jax.jacfwd, jax.jacrev):
        found = jax.jit(derivative(solution))(jnp.zeros(3))
        assert_allclose(found, expected, rtol=0, atol=1e-7 * np.max(np.abs(expected)))


@there
def test_predictive_control_gives_the_same_commands():
    from tests.control.predictive.test_mpc_law import commands

    states = jnp.asarray(np.random.default_rng(3).normal(size=(12, 6))) * 1e-3
    own, other = (commands(mpc(solver=solver), states) for solver in ("interior", "qpax"))
    assert np.any(own == 7.5) or np.any(np.isclose(own, 7.5))
    assert_allclose(other, own, rtol=0, atol=1e-8)


def test_where_it_is_missing_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match="pip install 'qpax>=0.1.4'"):
        by_qpax.least_distance(jnp.ones((1, 1)), jnp.ones(1))
    with pytest.raises(ValueError, match="controller.solver must be another: qpax is not"):
        check(rig(mpc(solver="qpax")))
