"""Matrices of the prediction, and bases of moves."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.controller import Estimate, Measurement
from jaxbeam.control.prediction import (
    SampledPlant,
    incremental_model,
    move_basis,
    move_maps,
    predict,
    preview,
    repeat_plant,
    sampled_plant,
)
from tests.control.optimal import test_crossing_lqr as crossing
from tests.control.predictive import test_mpc_exact as exact
from tests.loop_as_oracle import span_of
from tests.oracles.sampled_plant import over_period


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


# Maps of a plant over periods against scipy's integration of its equations.

PERIOD, DELAY, FIRST, COUNT = exact.PERIOD, 0.0037, 0, 3


def found_plants(case, period, delay, first, traced):
    def plants(plant):
        return preview(plant, np.asarray(period), delay).sampled_plants(
            np.asarray(first * period), 0, COUNT
        )

    return (eqx.filter_jit(plants) if traced else plants)(jb.state_space(case))


@pytest.mark.parametrize(("speed", "traced"), [(1.0, False), (10.0, False), (10.0, True)])
def test_a_mass_that_enters_within_a_period_and_a_delayed_command(speed, traced):
    case = exact.beam_case(speed=speed)
    span = span_of(case)
    events = exact.ENTRY, exact.ENTRY + span.length / speed
    found = found_plants(case, PERIOD, np.asarray(DELAY), FIRST, traced)

    def matrices_at(t):
        return exact.matrices(span, t, exact.MASS, speed)

    for i in range(COUNT):
        start = (FIRST + i) * PERIOD
        begin, end = start + DELAY, start + PERIOD
        A_before, B_before = over_period(matrices_at, start, begin, events)
        A_after, B_after = over_period(matrices_at, begin, end, events)
        B_before = A_after @ B_before
        weight = (B_before + B_after)[:, 2]
        expected = np.hstack([A_after @ A_before, B_before[:, :2]])
        assert_allclose(found.A[i, :4], expected, atol=1e-8 * np.abs(expected).max())
        assert_allclose(found.A[i, 4:], 0.0)
        expected = np.vstack([B_after[:, :2], np.eye(2)])
        assert_allclose(found.B[i], expected, atol=1e-8 * np.abs(B_after).max())
        assert_allclose(found.E[i, :4, 0], weight, atol=1e-8 * np.abs(weight).max())


@pytest.mark.parametrize("traced", [False, True])
def test_a_vehicle_on_a_rough_surface(traced):
    period, first = 0.02, 11
    found = found_plants(crossing.vehicle_beam_case(), period, None, first, traced)
    for i in range(COUNT):
        start = (first + i) * period
        A, B = over_period(crossing.vehicle_plant, start, start + period)
        scale = np.abs(A[:8]).max(axis=0)
        assert_allclose(found.A[i] / scale[:8], A[:8, :8] / scale[:8], atol=1e-8)
        assert_allclose(found.B[i], B[:8], atol=1e-8 * np.abs(B).max())
        assert_allclose(found.E[i] / scale[8:], A[:8, 8:] / scale[8:], atol=1e-8)


# Predictive control of a beam under a vehicle on a rough surface, against an explicit program.
#
# Plant by scipy's integration of the matrices in `test_crossing_lqr`; moves by least squares.

VEHICLE_PERIOD, HORIZON, MOVES, MOVE_WEIGHT = 0.02, 9, 4, 3e-7
SETTINGS = {
    "horizon": HORIZON,
    "moves": MOVES,
    "move_weight": MOVE_WEIGHT,
    "period": VEHICLE_PERIOD,
}
STATES, SAMPLE = 8, 12


@functools.cache
def sampled(period):
    """A, B and known inputs over a period, counted from t = 0."""
    start = period * VEHICLE_PERIOD
    A, B = over_period(crossing.vehicle_plant, start, start + VEHICLE_PERIOD)
    return A[:STATES, :STATES], B[:STATES], A[:STATES, STATES:]


def explicit_move(state, previous_state, previous_command):
    """First move of the minimum of the sum of w^2 at 1 m and of the weighted moves squared."""
    constants = crossing.START[STATES:]
    row = np.pad(crossing.SPAN.shapes(1.0), (0, STATES - crossing.VEHICLE_MODES))
    A, B, E = sampled(SAMPLE - 1)
    unexplained = state - (A @ previous_state + B[:, 0] * previous_command + E @ constants)

    def residuals(moves):
        x, command, found = state, previous_command, []
        for i in range(HORIZON):
            A, B, E = sampled(SAMPLE + i)
            command = command + (moves[i] if i < MOVES else 0.0)
            x = A @ x + B[:, 0] * command + E @ constants + unexplained
            found.append(row @ x)
        return np.append(found, np.sqrt(MOVE_WEIGHT) * moves)

    free = residuals(np.zeros(MOVES))
    columns = np.array([residuals(unit) - free for unit in np.eye(MOVES)]).T
    return np.linalg.lstsq(columns, -free, rcond=None)[0][0]


def test_moves_foresee_the_vehicle_and_the_profile():
    law = jb.MPC(**SETTINGS, loads="known", prediction="time-varying", solver="unconstrained")
    plant = jb.state_space(crossing.vehicle_beam_case(controller=law))
    design = law.design_state_law(plant, plant)
    draws = np.random.default_rng(4).normal(size=(2, STATES))
    scale = np.array([1e-2, 1e-3, 0.2, 0.1, 2e-3, 2e-3, 0.05, 0.05])
    state, previous = draws * scale
    estimate = Estimate(state[:4], vehicles=state[4:])
    measurement = Measurement(np.zeros(1), state[:4], np.array([0.7]))
    step = design.step(previous, estimate, measurement, np.asarray(SAMPLE * VEHICLE_PERIOD))
    expected = 0.7 + explicit_move(state, previous, 0.7)
    assert_allclose(step.command, [expected], rtol=1e-7)


def test_foresight_of_the_vehicle_beats_that_of_its_weight():
    """On a rough surface the static load is a poor prediction of the contact force."""
    foresight = jb.MPC(**SETTINGS, loads="known", prediction="time-varying")
    force = jb.MovingForce(mass=0.4, speed=crossing.SPEED)
    design = jb.state_space(crossing.vehicle_beam_case(force, profile=None))
    weight = jb.MPC(**SETTINGS, loads="known", prediction="time-varying", nominal_plant=design)
    peaks = [
        float(jb.simulate(crossing.vehicle_beam_case(controller=law)).peak_deflection[0])
        for law in (foresight, weight)
    ]
    assert peaks[0] < 0.8 * peaks[1]
