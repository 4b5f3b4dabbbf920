"""H-infinity laws: worst gains of the closed loop, the LQG limit, and SLICOT's least level."""

import jax
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

from jaxbeam.control.optimal.h_infinity import Game, is_attained, least_level, minimax_law
from jaxbeam.runtime.arrays import xp
from tests.differences import central


def game(noise=1.0, period=0.002) -> Game:
    """Two modes of a beam, a command, two forces and two readings, in states of like size."""
    omega, damping = np.array([130.0, 520.0]), 0.02
    at_command, at_sensors = np.array([1.0, -0.7]), np.array([[1.0, -0.7], [0.6, 0.9]])
    at_forces = np.array([[0.8, 0.5], [0.9, -0.4]])
    A = np.zeros((4, 4))
    A[:2, 2:], A[2:, :2], A[2:, 2:] = np.diag(omega), -np.diag(omega), -np.diag(2 * damping * omega)
    inputs = np.zeros((4, 3))
    inputs[2:] = np.column_stack([at_command, at_forces]) * 30
    whole = scipy.linalg.expm(period * np.block([[A, inputs], [np.zeros((3, 7))]]))
    C = np.hstack([at_sensors / omega * 40, np.zeros((2, 2))])
    Q = np.outer(C[0], C[0]) * 4
    B, E = whole[:4, 4:5], whole[:4, 5:]
    return Game(whole[:4, :4], B, C, E, Q, np.array([[0.5]]), np.diag([0.02, 0.05]) * noise)


def closed_loop(found: Game, law):
    """Matrices from (w, n), n of unit covariance, to z under a law."""
    A, B, C, E, Q, R, N = found
    noise, root = np.linalg.cholesky(N), np.linalg.cholesky(R).T
    values, vectors = np.linalg.eigh(Q)
    of_states = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
    D, K = np.asarray(law.D), np.asarray(law.K)
    states = np.block([[A + B @ D @ C, B @ K], [law.G @ C + B @ D @ C, law.F + B @ K]])
    inputs = np.block([[E, B @ D @ noise], [np.zeros(E.shape), (law.G + B @ D) @ noise]])
    outputs = np.block([[of_states, np.zeros(A.shape)], [root @ D @ C, root @ K]])
    through = np.block(
        [
            [np.zeros((len(A), len(noise) + E.shape[1]))],
            [np.zeros((1, E.shape[1])), root @ D @ noise],
        ]
    )
    return states, inputs, outputs, through


def worst_gain(found: Game, law, frequencies=4001) -> float:
    states, inputs, outputs, through = closed_loop(found, law)
    assert np.max(np.abs(np.linalg.eigvals(states))) < 1
    turns = np.exp(1j * np.linspace(0, np.pi, frequencies))[:, None, None]
    gains = outputs @ np.linalg.solve(turns * np.eye(len(states)) - states, inputs) + through
    return float(np.max(np.linalg.norm(gains, 2, axis=(1, 2))))


@pytest.mark.parametrize("noise", [1.0, 1e-4])
def test_worst_gain_of_the_loop_is_the_level(noise):
    found = game(noise)
    least = least_level(found)
    assert is_attained(found, 1.0001 * least) and not is_attained(found, 0.9999 * least)
    assert_allclose(worst_gain(found, minimax_law(found, 1.0001 * least)), least, rtol=2e-4)
    for factor in (1.1, 2.0):
        assert worst_gain(found, minimax_law(found, factor * least)) < factor * least


def test_tends_to_the_lqg_law():
    """Gain of scipy's discrete Riccati equation on the state filtered with the reading."""
    found = game()
    A, B, C, E, Q, R, N = found
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    spread = scipy.linalg.solve_discrete_are(A.T, C.T, E @ E.T, N)
    filter_gain = spread @ C.T @ np.linalg.inv(C @ spread @ C.T + N)
    law = minimax_law(found, np.asarray(1e6))
    assert_allclose(law.D, -gain @ filter_gain, rtol=1e-8)
    assert_allclose(law.K, -gain @ (np.eye(4) - filter_gain @ C), rtol=1e-8)
    assert_allclose(law.F, A @ (np.eye(4) - filter_gain @ C), rtol=1e-8, atol=1e-10)


def test_least_level_is_that_of_slicot():
    """By the bilinear transform, which keeps the norm: SB10AD is in continuous time.

    Its bisection, job 1: `control.hinfsyn` goes on to scan, and may then name a level that its own
    law does not attain.
    """
    slycot = pytest.importorskip("slycot")
    A, B, C, E, Q, R, N = found = game()
    row = 2 * C[:1]
    assert_allclose(row.T @ row, Q)
    inputs = np.hstack([E, np.zeros((4, 2)), B])
    outputs = np.vstack([row, np.zeros((1, 4)), C])
    through = np.zeros((4, 5))
    through[1, 4], through[2:, 2:4] = np.sqrt(R[0, 0]), np.sqrt(N)
    inverse = np.linalg.inv(A + np.eye(4))
    plant = (
        inverse @ (A - np.eye(4)),
        np.sqrt(2) * inverse @ inputs,
        np.sqrt(2) * outputs @ inverse,
        through - outputs @ inverse @ inputs,
    )
    level, *_ = slycot.sb10ad(4, 5, 4, 1, 2, 10.0, *plant, job=1, gtol=1e-9)
    assert_allclose(least_level(found), level, rtol=1e-6)


@pytest.mark.parametrize("level", [3.0, None], ids=["given", "least"])
def test_derivatives(level):
    """Of the law by weights of reading, command, noise and force; differences of known numbers."""

    def numbers(point):
        start = game()
        changed = start._replace(
            Q=start.Q * point[0], R=start.R * point[1], N=start.N * point[2], E=start.E * point[3]
        )
        at = xp.asarray(1.1 * least_level(changed) if level is None else level)
        return xp.concatenate([xp.ravel(part) for part in minimax_law(changed, at)])

    found = jax.jit(jax.jacfwd(numbers))(jax.numpy.ones(4))
    assert_allclose(found, central(numbers, np.ones(4), 0.01), rtol=2e-5, atol=1e-6)


def test_no_law_for_an_undamped_mode_out_of_reach():
    found = game()
    unreached = found._replace(A=np.diag([1.2, 0.5, 0.4, 0.3]), B=np.array([[0.0], [1], [1], [1]]))
    with pytest.raises(ValueError, match="no law makes the loop stable"):
        least_level(unreached)
