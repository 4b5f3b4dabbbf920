"""Quadratic programs: against another solver, optimality conditions, derivatives."""

import clarabel
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from numpy.testing import assert_allclose, assert_array_equal

from jaxbeam.numerics.qp import INFEASIBLE, METHODS, SOLVED, UNFINISHED, solve_qp
from tests.differences import central

SIZES = [(3, 8), (6, 12), (8, 32)]
COUNT = 500


def problems(kind: str, variables: int, rows: int, count: int = COUNT):
    """Random H, f, M and gamma; all but the infeasible ones are feasible by construction."""
    rng = np.random.default_rng([variables, len(kind)])
    root = rng.normal(size=(count, variables, variables))
    ridge = 10 ** rng.uniform(-2, 0, (count, 1, 1)) * np.eye(variables)
    H, f = root @ root.mT + ridge, 3 * rng.normal(size=(count, variables))
    M, inside = rng.normal(size=(count, rows, variables)), rng.normal(size=(count, variables))
    if kind == "parallel rows":
        half = rows // 2
        M[:, half:] = M[:, : rows - half] * rng.uniform(0.5, 2.0, (count, rows - half, 1))
    gamma = np.einsum("nij,nj->ni", M, inside)
    if kind == "plain":
        gamma += rng.uniform(0, 1, (count, rows)) * (rng.uniform(size=(count, rows)) < 0.6)
    if kind == "redundant rows":  # the mean of two rows, active where both are
        M[:, -1] = (M[:, 0] + M[:, 1]) / 2
        gamma[:, -1] = (gamma[:, 0] + gamma[:, 1]) / 2 + rng.choice([0.0, 0.1], count)
    if kind == "all rows active":  # in a vertex, many with multiplier zero
        multipliers = rng.uniform(size=(count, rows)) * (rng.uniform(size=(count, rows)) < 0.5)
        f = -np.einsum("nij,nj->ni", H, inside) - np.einsum("nij,ni->nj", M, multipliers)
    if kind == "infeasible":  # two opposite rows exclude each other, by little or much
        M[:, 1] = -M[:, 0] * rng.uniform(0.5, 2.0, (count, 1))
        share = np.linalg.norm(M[:, 1], axis=1) / np.linalg.norm(M[:, 0], axis=1)
        gamma[:, 1] = -gamma[:, 0] * share - 10 ** rng.uniform(-3, 0, count)
    return tuple(map(jnp.asarray, (H, f, M, gamma)))


FEASIBLE = ["plain", "parallel rows", "redundant rows", "all rows active"]


@pytest.fixture(scope="module")
def solve():
    return {name: jax.jit(jax.vmap(lambda *p, m=name: solve_qp(*p, m))) for name in METHODS}


def by_clarabel(*given):
    H, f, M, gamma = map(np.asarray, given)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    sparse = scipy.sparse.csc_matrix
    cones = [clarabel.NonnegativeConeT(gamma.size)]
    upper = scipy.sparse.triu(sparse(H), format="csc")
    return clarabel.DefaultSolver(upper, f, sparse(M), gamma, cones, settings).solve()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", FEASIBLE)
def test_solutions_by_optimality_conditions_and_against_clarabel(kind, size, solve):
    """Stationarity, limits, signs and complementarity are sufficient for a convex problem."""
    H, f, M, gamma = given = problems(kind, *size)
    found = solve["interior"](*given)
    assert_array_equal(found.status, SOLVED)
    x, multipliers = np.asarray(found.x), np.asarray(found.multipliers)
    slack = gamma - np.einsum("nij,nj->ni", M, x)
    stationarity = np.einsum("nij,nj->ni", H, x) + f + np.einsum("nij,ni->nj", M, multipliers)
    assert np.all(multipliers >= 0)
    scale = 1 + np.max(np.abs(x)) + np.max(multipliers)
    assert_allclose(stationarity, 0, atol=1e-9 * scale)
    assert np.min(slack) > -1e-9 * scale
    assert_allclose(np.minimum(slack, multipliers), 0, atol=1e-9 * scale)
    unsolved = 0  # by Clarabel, where limits are degenerate
    for i in range(0, COUNT, 5):
        other = by_clarabel(H[i], f[i], M[i], gamma[i])
        if str(other.status) not in ("Solved", "AlmostSolved"):
            unsolved += 1
            continue
        least = x[i] @ H[i] @ x[i] / 2 + f[i] @ x[i]
        assert_allclose(least, other.obj_val, rtol=1e-8, atol=1e-8)
        # Its gap of 1e-8 determines x to sqrt(2 gap / least eigenvalue of H).
        assert_allclose(x[i], other.x, rtol=0, atol=(2e-8 / np.linalg.eigvalsh(H[i])[0]) ** 0.5)
    assert unsolved <= COUNT // 250


@pytest.mark.parametrize("kind", FEASIBLE)
def test_both_methods_agree(kind, solve):
    """To 1e-8, where Hildreth's procedure converges within its sweeps."""
    given = problems(kind, 6, 12, count=200)
    interior, hildreth = (solve[name](*given) for name in METHODS)
    converged = np.asarray(hildreth.solved)
    assert np.mean(converged) > 0.85
    assert np.all(converged | (np.asarray(hildreth.status) == UNFINISHED))
    assert_allclose(interior.x[converged], hildreth.x[converged], rtol=0, atol=1e-8)


@pytest.mark.parametrize("size", SIZES)
def test_infeasible_problems(size, solve):
    given = problems("infeasible", *size)
    assert_array_equal(solve["interior"](*given).status, INFEASIBLE)
    few = [part[:30] for part in given]
    hildreth = solve["hildreth"](*few)
    assert not np.any(hildreth.solved)
    if size == SIZES[0]:  # with many rows the sweeps may end before the proof
        assert np.mean(np.asarray(hildreth.status) == INFEASIBLE) > 0.8
    assert "Infeasible" in str(by_clarabel(*(part[0] for part in given)).status)


@pytest.mark.parametrize("method", METHODS)
def test_accuracy_does_not_depend_on_units(method):
    """In metres and volts H and f are of the order 1e-9."""
    H, f, M, gamma = (part[3] for part in problems("plain", 6, 12))
    unscaled = solve_qp(H, f, M, gamma, method)
    row, unit = np.logspace(-4, 4, 12), np.logspace(-2, 2, 6)
    scaled = solve_qp(
        1e-9 * H * unit * unit[:, None],
        1e-9 * f * unit,
        M * unit * row[:, None],
        gamma * row,
        method,
    )
    assert scaled.solved
    assert_allclose(scaled.x * unit, unscaled.x, rtol=0, atol=1e-9)


def test_numbers_that_are_not_finite_in_a_batch(solve):
    """In large batches XLA's maxima ignore NaN; such problems must not count as solved."""
    H, f, M, gamma = problems("plain", 6, 12)
    invalid = np.arange(COUNT) % 7 == 0
    for given in (
        (H, jnp.where(invalid[:, None], jnp.nan, f)),
        (jnp.where(invalid[:, None, None], -H, H), f),
    ):
        status = np.asarray(solve["interior"](*given, M, gamma).status)
        assert_array_equal(status, np.where(invalid, UNFINISHED, SOLVED))


@pytest.mark.parametrize("method", METHODS)
def test_no_steps_where_no_limit_is_active(method):
    found = solve_qp(2 * jnp.eye(2), jnp.array([1.0, -1.0]), jnp.eye(2), jnp.ones(2), method)
    assert_allclose(found.x, [-0.5, 0.5], rtol=1e-15)
    assert found.solved and found.steps == 0
    assert_array_equal(found.multipliers, 0.0)


@pytest.mark.parametrize("method", METHODS)
def test_invalid_problems_are_not_solved(method):
    eye, ones = jnp.eye(2), jnp.ones(2)
    numbers = [(-eye, ones, ones), (eye, ones * jnp.nan, ones), (eye, ones, -ones * jnp.inf)]
    for H, f, gamma in numbers:
        assert solve_qp(H, f, eye, gamma, method).status == UNFINISHED


def test_limits_far_away_change_nothing():
    """Their slack is rounded by more than the tolerance of limits that matter."""
    for problem in zip(*(np.asarray(part[:5]) for part in problems("plain", 4, 8)), strict=True):
        H, f, M, gamma = problem
        far = np.append(M, M[:, ::-1], axis=0), np.append(gamma, np.full(8, 3e9))
        found, expected = solve_qp(H, f, *far), solve_qp(*problem)
        assert found.solved and found.steps < 30
        assert_allclose(found.x, expected.x, rtol=0, atol=1e-9)


def test_unknown_methods_are_refused():
    with pytest.raises(ValueError, match="no method 'simplex'; there are interior, hildreth"):
        solve_qp(jnp.eye(1), jnp.ones(1), jnp.eye(1), jnp.ones(1), "simplex")


@pytest.mark.parametrize("method", METHODS)
def test_derivatives(method):
    """Forward and reverse, by H, f, M and gamma, against differences."""
    given = [part[5] for part in problems("plain", 3, 8)]
    rng = np.random.default_rng(1)
    directions = [rng.normal(size=(2, *part.shape)) for part in given]
    directions[0] = directions[0] + directions[0].mT

    @jax.jit
    def solution(change):
        moved = [p + jnp.tensordot(change, w, 1) for p, w in zip(given, directions, strict=True)]
        found = solve_qp(*moved, method)
        return jnp.concatenate([found.x, found.multipliers])

    assert jnp.sum(solution(jnp.zeros(2))[3:] > 1e-6) in (1, 2)
    expected = central(solution, np.zeros(2), 1e-4)
    size = np.max(np.abs(expected))
    for derivative in (jax.jacfwd, jax.jacrev):
        found = jax.jit(derivative(solution))(jnp.zeros(2))
        assert_allclose(found, expected, rtol=0, atol=1e-7 * size)


def test_derivative_at_a_limit_and_with_equal_rows():
    """min (x - a)^2 / 2 with x <= 0: dx/da is 1 below the limit, 0 above, and 1/2 at it."""

    def least(a, rows):
        return solve_qp(jnp.eye(1), -a[None], jnp.ones((rows, 1)), jnp.zeros(rows)).x[0]

    for rows in (1, 2):
        slope = jax.jit(jax.grad(lambda a, rows=rows: least(a, rows)))
        assert_allclose([slope(jnp.array(a)) for a in (-0.1, 0.1)], [1.0, 0.0], atol=1e-9)
        if rows == 1:
            assert_allclose(slope(jnp.array(0.0)), 0.5, atol=1e-9)
