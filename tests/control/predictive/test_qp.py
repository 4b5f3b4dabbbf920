"""Quadratic programs by the thousand: against another solver, by certificates, derivatives."""

import clarabel
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from numpy.testing import assert_allclose, assert_array_equal

from jaxbeam.control.predictive.qp import INFEASIBLE, SOLVED, UNFINISHED, solve_qp
from tests.differences import central

METHODS = ("interior", "hildreth")  # qpax has its own tests
SIZES = [(3, 8), (6, 12), (8, 32)]
COUNT = 500


def problems(kind: str, variables: int, rows: int, count: int = COUNT):
    """Random H, f, M and gamma; all but the infeasible ones are feasible by construction."""
    rng = np.random.default_rng([variables, len(kind)])
    root = rng.normal(size=(count, variables, variables))
    ridge = 10 ** rng.uniform(-2, 0, (count, 1, 1)) * np.eye(variables)
    H, f = root @ root.mT + ridge, 3 * rng.normal(size=(count, variables))
    M, inside = rng.normal(size=(count, rows, variables)), rng.normal(size=(count, variables))
    if kind == "twice the same rows":
        half = rows // 2
        M[:, half:] = M[:, : rows - half] * rng.uniform(0.5, 2.0, (count, rows - half, 1))
    gamma = np.einsum("nij,nj->ni", M, inside)
    if kind == "plain":
        gamma += rng.uniform(0, 1, (count, rows)) * (rng.uniform(size=(count, rows)) < 0.6)
    if kind == "redundant rows":  # the mean of two rows is as tight as both where both are active
        M[:, -1] = (M[:, 0] + M[:, 1]) / 2
        gamma[:, -1] = (gamma[:, 0] + gamma[:, 1]) / 2 + rng.choice([0.0, 0.1], count)
    if kind == "all rows active":  # in a vertex, many without a multiplier
        push = rng.uniform(size=(count, rows)) * (rng.uniform(size=(count, rows)) < 0.5)
        f = -np.einsum("nij,nj->ni", H, inside) - np.einsum("nij,ni->nj", M, push)
    if kind == "infeasible":  # a row that its opposite excludes, by little or much
        M[:, 1] = -M[:, 0] * rng.uniform(0.5, 2.0, (count, 1))
        share = np.linalg.norm(M[:, 1], axis=1) / np.linalg.norm(M[:, 0], axis=1)
        gamma[:, 1] = -gamma[:, 0] * share - 10 ** rng.uniform(-3, 0, count)
    return tuple(map(jnp.asarray, (H, f, M, gamma)))


FEASIBLE = ["plain", "twice the same rows", "redundant rows", "all rows active"]


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
def test_solutions_against_another_solver_and_by_their_certificates(kind, size, solve):
    """Stationarity, limits, signs and complementarity prove a solution of a convex problem."""
    H, f, M, gamma = given = problems(kind, *size)
    found = solve["interior"](*given)
    assert_array_equal(found.verdict, SOLVED)
    x, multipliers = np.asarray(found.x), np.asarray(found.multipliers)
    slack = gamma - np.einsum("nij,nj->ni", M, x)
    pull = np.einsum("nij,nj->ni", H, x) + f + np.einsum("nij,ni->nj", M, multipliers)
    assert np.all(multipliers >= 0)
    scale = 1 + np.max(np.abs(x)) + np.max(multipliers)
    assert_allclose(pull, 0, atol=1e-9 * scale)
    assert np.min(slack) > -1e-9 * scale
    assert_allclose(np.minimum(slack, multipliers), 0, atol=1e-9 * scale)
    lost = 0  # by the other, now and then, where limits are degenerate
    for i in range(0, COUNT, 2):
        other = by_clarabel(H[i], f[i], M[i], gamma[i])
        if str(other.status) not in ("Solved", "AlmostSolved"):
            lost += 1
            continue
        least = x[i] @ H[i] @ x[i] / 2 + f[i] @ x[i]
        assert_allclose(least, other.obj_val, rtol=1e-8, atol=1e-8)
        # Its gap of 1e-8 leaves x open by sqrt(2 gap / least eigenvalue of H) or less.
        assert_allclose(x[i], other.x, rtol=0, atol=(2e-8 / np.linalg.eigvalsh(H[i])[0]) ** 0.5)
    assert lost <= COUNT // 100


@pytest.mark.parametrize("kind", FEASIBLE)
def test_both_methods_find_the_same(kind, solve):
    """To 1e-8, wherever Hildreth's procedure converges in the sweeps it is allowed."""
    given = problems(kind, 6, 12, count=200)
    interior, hildreth = (solve[name](*given) for name in METHODS)
    settled = np.asarray(hildreth.solved)
    assert np.mean(settled) > 0.85
    assert np.all(settled | (np.asarray(hildreth.verdict) == UNFINISHED))
    assert_allclose(interior.x[settled], hildreth.x[settled], rtol=0, atol=1e-8)


@pytest.mark.parametrize("size", SIZES)
def test_infeasible_problems_are_known_as_such(size, solve):
    given = problems("infeasible", *size)
    assert_array_equal(solve["interior"](*given).verdict, INFEASIBLE)
    few = [part[:30] for part in given]
    hildreth = solve["hildreth"](*few)
    assert not np.any(hildreth.solved)
    if size == SIZES[0]:  # with many rows it may be still sweeping when it has to stop
        assert np.mean(np.asarray(hildreth.verdict) == INFEASIBLE) > 0.8
    assert "Infeasible" in str(by_clarabel(*(part[0] for part in given)).status)


@pytest.mark.parametrize("method", METHODS)
def test_units_do_not_matter(method):
    """A problem in metres and volts has numbers of 1e-9: the solution is as exact."""
    H, f, M, gamma = (part[3] for part in problems("plain", 6, 12))
    plain = solve_qp(H, f, M, gamma, method)
    row, unit = np.logspace(-4, 4, 12), np.logspace(-2, 2, 6)
    scaled = solve_qp(
        1e-9 * H * unit * unit[:, None],
        1e-9 * f * unit,
        M * unit * row[:, None],
        gamma * row,
        method,
    )
    assert scaled.solved
    assert_allclose(scaled.x * unit, plain.x, rtol=0, atol=1e-9)


def test_no_batch_hides_what_is_not_finite(solve):
    """In large batches XLA's maxima pass over NaN: one that is lost must not seem solved."""
    H, f, M, gamma = problems("plain", 6, 12)
    lost = np.arange(COUNT) % 7 == 0
    for given in (
        (H, jnp.where(lost[:, None], jnp.nan, f)),
        (jnp.where(lost[:, None, None], -H, H), f),
    ):
        verdict = np.asarray(solve["interior"](*given, M, gamma).verdict)
        assert_array_equal(verdict, np.where(lost, UNFINISHED, SOLVED))


@pytest.mark.parametrize("method", METHODS)
def test_limits_that_are_not_felt_cost_nothing(method):
    found = solve_qp(2 * jnp.eye(2), jnp.array([1.0, -1.0]), jnp.eye(2), jnp.ones(2), method)
    assert_allclose(found.x, [-0.5, 0.5], rtol=1e-15)
    assert found.solved and found.steps == 0
    assert_array_equal(found.multipliers, 0.0)


@pytest.mark.parametrize("method", METHODS)
def test_what_is_no_problem_is_not_solved(method):
    eye, ones = jnp.eye(2), jnp.ones(2)
    numbers = [(-eye, ones, ones), (eye, ones * jnp.nan, ones), (eye, ones, -ones * jnp.inf)]
    for H, f, gamma in numbers:
        assert solve_qp(H, f, eye, gamma, method).status == UNFINISHED


def test_unknown_methods_are_refused():
    with pytest.raises(ValueError, match="no method 'simplex'; there are interior, hildreth, qpax"):
        solve_qp(jnp.eye(1), jnp.ones(1), jnp.eye(1), jnp.ones(1), "simplex")


@pytest.mark.parametrize("method", METHODS)
def test_derivatives(method):
    """Forward and in reverse against differences, by all four of H, f, M and gamma."""
    given = [part[5] for part in problems("plain", 3, 8)]
    rng = np.random.default_rng(1)
    ways = [rng.normal(size=(2, *part.shape)) for part in given]
    ways[0] = ways[0] + ways[0].mT

    @jax.jit
    def solution(change):
        moved = [p + jnp.tensordot(change, w, 1) for p, w in zip(given, ways, strict=True)]
        found = solve_qp(*moved, method)
        return jnp.concatenate([found.x, found.multipliers])

    assert jnp.sum(solution(jnp.zeros(2))[3:] > 1e-6) in (1, 2)
    expected = central(solution, np.zeros(2), 1e-4)
    size = np.max(np.abs(expected))
    for derivative in (jax.jacfwd, jax.jacrev):
        found = jax.jit(derivative(solution))(jnp.zeros(2))
        assert_allclose(found, expected, rtol=0, atol=1e-7 * size)


def test_derivatives_where_they_jump_and_where_rows_are_equal():
    """min (x - a)^2 / 2 with x <= 0: dx/da is 1 before the limit, 0 behind, and 1/2 upon it."""

    def least(a, rows):
        return solve_qp(jnp.eye(1), -a[None], jnp.ones((rows, 1)), jnp.zeros(rows)).x[0]

    for rows in (1, 2):
        slope = jax.jit(jax.grad(lambda a, rows=rows: least(a, rows)))
        assert_allclose([slope(jnp.array(a)) for a in (-0.1, 0.1)], [1.0, 0.0], atol=1e-9)
        if rows == 1:
            assert_allclose(slope(jnp.array(0.0)), 0.5, atol=1e-9)
