"""Matrices of the prediction, and bases of moves."""

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from numpy.testing import assert_allclose, assert_array_equal

from jaxbeam.control.predictive.prediction import (
    SampledPlant,
    incremental_model,
    move_basis,
    move_maps,
    predict,
    repeat_plant,
    sampled_plant,
)


def plant(states=4, inputs=2, outputs=2, seed=0):
    rng = np.random.default_rng(seed)
    A = 0.9 * scipy.linalg.orth(rng.normal(size=(states, states)))
    B, C = rng.normal(size=(states, inputs)), rng.normal(size=(outputs, states))
    return jnp.asarray(A), jnp.asarray(B), jnp.asarray(C)


def test_prediction_against_the_incremental_model():
    """F and Phi of eq. (7.5) of the thesis, from the matrices of eq. (7.1)."""
    A, B, C = plant()
    A_incremental, B_incremental, rows = map(np.asarray, incremental_model(A, B, C))
    maps = move_maps(move_basis(5, 3), 2)
    plants = repeat_plant(SampledPlant(A, B, jnp.zeros((4, 0))), 5)
    found = predict(plants, C, maps, jnp.zeros(0))
    power = [np.linalg.matrix_power(A_incremental, n) for n in range(6)]
    F = np.stack([rows @ power[n] for n in range(1, 6)])
    Phi = np.zeros((5, 2, 6))
    for i in range(5):
        for j in range(min(i + 1, 3)):
            Phi[i, :, 2 * j : 2 * j + 2] = rows @ power[i - j] @ B_incremental
    assert_allclose(found.Phi, Phi, atol=1e-14)
    previous, state, command = np.random.default_rng(1).normal(size=(3, 4))
    command = command[:2]
    unexplained = state - A @ previous - B @ command
    free_response = found.F @ np.concatenate([state, unexplained, command, [1.0]])
    assert_allclose(free_response, F @ np.concatenate([state - previous, C @ state]), atol=1e-13)
    end = np.asarray(found.end)
    assert_allclose(C @ end[4:8], found.F[-1], atol=1e-14)
    assert_allclose(C @ end[:4], found.F[-2], atol=1e-14)
    assert_array_equal(end[8:], np.eye(2, 11, k=8))


def test_sampling_with_a_delay():
    rng = np.random.default_rng(2)
    A, B, E = (jnp.asarray(rng.normal(size=s)) for s in ((3, 3), (3, 1), (3, 2)))
    found = sampled_plant(A, B, E, jnp.array(0.3), jnp.array(0.1))
    state, previous, command, weights = rng.normal(size=3), *rng.normal(size=2), rng.normal(size=2)
    for span, u in ((0.1, previous), (0.2, command)):  # by the exponential of the forced system
        rate = np.block([[A, (B[:, 0] * u + E @ weights)[:, None]], [np.zeros((1, 4))]])
        if span == 0.1:
            after = (scipy.linalg.expm(span * rate) @ np.append(state, 1.0))[:3]
        else:
            after = (scipy.linalg.expm(span * rate) @ np.append(after, 1.0))[:3]
    next_state = (
        found.A @ np.append(state, previous) + found.B @ np.array([command]) + found.E @ weights
    )
    assert_allclose(next_state, np.append(after, command), rtol=1e-12)


def test_laguerre_functions():
    """Orthonormal; unit moves at pole 0."""
    found = move_basis(200, 5, jnp.array(0.7))
    assert_allclose(found.T @ found, np.eye(5), atol=1e-12)
    assert_array_equal(move_basis(6, 4, jnp.array(0.0)), move_basis(6, 4))
