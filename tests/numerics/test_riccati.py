"""Riccati equations: against scipy, python-control and a stiff integration of (3.8)."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from jaxbeam.numerics.batched_linalg import batch_axis_last
from jaxbeam.numerics.riccati import care, dare, dlqr, lqr, lyapunov, stein
from jaxbeam.numerics.stages import GAUSS_NODES, collocated_stages, riccati_recursion
from tests.differences import central

R = jnp.array([[0.1, 0.02], [0.02, 0.3]])


def cost_to_go(stages, terminal_cost):
    """P at the start of each interval and at the end."""
    return batch_axis_last(riccati_recursion, stages, jnp.zeros((1, 1)), terminal_cost)


def plant(seed=0, states=6):
    """A, B, Q and N of a random unstable plant with a fast lag."""
    random = np.random.default_rng(seed)
    A, B = random.normal(size=(states, states)), random.normal(size=(states, 2))
    A[-1, -1] = -1e4
    half = random.normal(size=(states, states))
    N = 0.05 * random.normal(size=(states, 2))
    return [jnp.asarray(part) for part in (A, B, np.eye(states) + half @ half.T, N)]


def assert_close(found, expected, tolerance):
    assert_allclose(found, expected, rtol=0, atol=tolerance * np.max(np.abs(expected)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_algebraic_equations_against_scipy(seed):
    A, B, Q, N = plant(seed)
    assert_close(care(A, B, Q, R), scipy.linalg.solve_continuous_are(A, B, Q, R), 1e-11)
    assert_close(care(A, B, Q, R, N), scipy.linalg.solve_continuous_are(A, B, Q, R, s=N), 1e-11)
    A = A.at[-1, -1].set(0.3)
    assert_close(dare(A, B, Q, R), scipy.linalg.solve_discrete_are(A, B, Q, R), 1e-11)
    assert_close(dare(A, B, Q, R, N), scipy.linalg.solve_discrete_are(A, B, Q, R, s=N), 1e-11)


def test_gains_against_python_control():
    A, B, Q, N = plant()
    gain, cost, _ = control.lqr(*map(np.asarray, (A, B, Q, R, N)))
    found = lqr(A, B, Q, R, N)
    assert_close(found[0], gain, 1e-10)
    assert_close(found[1], cost, 1e-10)
    A = A.at[-1, -1].set(0.3)
    gain, _, _ = control.dlqr(*map(np.asarray, (A, B, Q, R, N)))
    assert_close(dlqr(A, B, Q, R, N)[0], gain, 1e-10)


def test_lyapunov_and_stein_equations():
    A, _, Q, _ = plant()
    A = A - 5 * jnp.eye(6)
    assert_close(lyapunov(A, Q), scipy.linalg.solve_continuous_lyapunov(A.T, -Q), 1e-12)
    A = A.at[-1, -1].set(0.3) / 12
    assert_close(stein(A, Q), scipy.linalg.solve_discrete_lyapunov(A.T, Q), 1e-12)


@pytest.mark.parametrize("solve", [lqr, dlqr])
def test_derivatives_forward_and_in_reverse(solve):
    A, B, _, N = plant(3, 4)
    A = A.at[-1, -1].set(-40.0 if solve is lqr else 0.3)

    def gain(numbers):
        weights = jnp.diag(jnp.exp(numbers[:4]))
        return solve(A * numbers[4], B, weights, R * numbers[5], N * numbers[4])[0]

    point = jnp.array([0.1, -0.3, 0.2, 1.0, 1.0, 1.0])
    forward = jax.jit(jax.jacfwd(gain))(point)
    assert_close(forward, central(jax.jit(gain), point, 1e-3), 1e-8)
    assert_close(jax.jit(jax.jacrev(gain))(point), forward, 1e-10)


def test_batch_of_weights():
    A, B, Q, _ = plant()
    factors = jnp.array([0.5, 1.0, 100.0])
    found = jax.jit(jax.vmap(lambda factor: care(A, B, factor * Q, R)))(factors)
    for factor, each in zip(factors, found, strict=True):
        assert_close(each, scipy.linalg.solve_continuous_are(A, B, factor * Q, R), 1e-11)


def test_equations_without_a_solution_are_refused():
    A, B, Q, _ = plant()
    with pytest.raises(ValueError, match="R must be positive definite"):
        care(A, B, Q, -R)
    with pytest.raises(ValueError, match="Q must be positive semidefinite"):
        care(A, B, Q.at[0, 0].set(-9.0), R)
    with pytest.raises(ValueError, match="Q must be symmetric"):
        dare(A, B, Q.at[0, 1].set(9.0), R)
    with pytest.raises(ValueError, match="no stabilising solution"):
        care(jnp.eye(6), 0 * B, Q, R)
    assert jnp.isnan(jax.jit(care)(jnp.eye(6), 0 * B, Q, R)).all()


def varying(t):
    """A(t) and B of an oscillator of varying stiffness and coupling, driven through a fast lag."""
    one, zero = jnp.ones_like(t), jnp.zeros_like(t)
    stiff = -400.0 - 100 * jnp.sin(3 * t)
    rows = [
        [zero, one, zero],
        [stiff, -1.0 * one, 20 + 5 * jnp.cos(2 * t)],
        [zero, zero, -1e4 * one],
    ]
    return jnp.stack([jnp.stack(row) for row in rows]), jnp.array([[0.0], [0.0], [1e4]])


def test_backward_equation_against_a_stiff_integrator():
    """dP/dt = -PA - A'P - Q + P B R^-1 B'P by scipy's Radau at 1e-11, lag at 1e4 1/s."""
    Q, weight = np.diag([1000.0, 0.1, 0.0]), np.array([[0.01]])
    span, count = 1.0, 256
    breakpoints = np.linspace(0.0, span, count + 1)
    breakpoints = np.append(
        breakpoints[:-1], span - (breakpoints[1] - breakpoints[0]) * 0.5 ** np.arange(13)
    )
    breakpoints = np.append(np.unique(breakpoints), span)
    lengths = jnp.diff(jnp.asarray(breakpoints))

    @jax.jit
    def solve():
        A, B = jax.vmap(jax.vmap(varying))(breakpoints[:-1, None] + lengths[:, None] * GAUSS_NODES)
        stages = collocated_stages(A, B, jnp.asarray(Q), jnp.asarray(weight), lengths)
        return cost_to_go(stages, jnp.asarray(Q))

    def riccati_rate(s, cost):
        t = span - s
        A = np.array([[0, 1, 0], [-400 - 100 * np.sin(3 * t), -1, 20 + 5 * np.cos(2 * t)],
                      [0, 0, -1e4]])  # fmt: skip
        P = cost.reshape(3, 3)
        BP = np.array([[0.0, 0.0, 1e4]]) @ P
        return (P @ A + A.T @ P + Q - BP.T @ BP / weight).ravel()

    indices = np.array([0, 64, 128, 192, 240])
    times = span - breakpoints[indices]
    solution = solve_ivp(
        riccati_rate, (0.0, span), Q.ravel(), "Radau", times[::-1], rtol=1e-11, atol=1e-14
    ).y.T[::-1]
    found = np.asarray(solve())[indices]
    for each, expected in zip(found, solution.reshape(-1, 3, 3), strict=True):
        assert_allclose(each, expected, rtol=1e-8, atol=1e-11 * np.max(np.abs(expected)))
