"""Generalised predictive control against a published example, step responses and simulations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.predictive.gpc import (
    PolynomialModel,
    polynomial_model,
    predicted_outputs,
    predictive_gains,
)
from tests.differences import central
from tests.loop_as_oracle import span_of

PERIOD, LIMITS = 0.01, [-3.0, 3.0]
LAW = jb.GPC(horizon=8, moves=3, move_weight=1e-9, period=PERIOD)


def beam_case(controller=LAW, **changes) -> jb.Case:
    parts = {
        "actuators": [jb.PointForce(0.2, limits=LIMITS), jb.PointForce(0.4, limits=LIMITS)],
        "sensors": [jb.Sensor(0.2), jb.Sensor(0.42)],
        "loads": [jb.MovingForce(mass=0.3, speed=0.8, deceleration=1.0)],  # stops at 0.32 m
        "run": jb.Run(0.9, 100.0),
    }
    beam = jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2)
    return jb.Case(beam, controller=controller, **(parts | changes))


def sampled_oracle():
    """Sampled plant (A, B, C) of the case by modal sums and scipy's exponential."""
    span = span_of(beam_case())
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.diag(span.frequencies**2), -span.damping]])
    shapes = np.stack([span.shapes(x) for x in (0.2, 0.4)], axis=1)
    B = np.vstack([np.zeros((2, 2)), shapes])
    C = np.hstack([np.stack([span.shapes(x) for x in (0.2, 0.42)]), np.zeros((2, 2))])
    return scipy.signal.cont2discrete((A, B, C, np.zeros((2, 2))), PERIOD)[:3]


def test_published_example():
    """y(k) = 0.8 y(k-1) + 0.4 u(k-1) + 0.6 u(k-2), N = 3, weight 0.8.

    du = -0.604 du(k-1) - 1.371 y(k) + 0.805 y(k-1) + 0.133 w1 + 0.286 w2 + 0.147 w3: Camacho and
    Bordons, Model Predictive Control, 2nd edition, Springer 2007, section 4.2. The last digits are
    cut off there.
    """
    model = PolynomialModel(np.array([-0.8, 0.0]), np.array([[[0.4]], [[0.6]]]))
    gains = predictive_gains(model, (1, 3, 3), np.ones(1), np.array([0.8]), np.ones(1))
    assert_allclose(gains.reading_gains.ravel(), [1.371, -0.805, 0.0], atol=1e-3)
    assert_allclose(gains.command_gains.ravel(), [0.604 - 1.0, -0.604], atol=1e-3)
    assert_allclose(gains.reference_command, 0.133 + 0.286 + 0.147, atol=1.5e-3)


def test_polynomials_are_those_of_scipy():
    A, B, C = sampled_oracle()
    model = polynomial_model(A, B, C)
    for actuator in range(2):
        numerators, denominator = scipy.signal.ss2tf(A, B, C, np.zeros((2, 2)), input=actuator)
        assert_allclose(model.denominator, denominator[1:], rtol=1e-9)
        scale = np.abs(numerators).max()
        assert_allclose(model.numerators[:, :, actuator].T, numerators[:, 1:], atol=1e-9 * scale)


def test_law_against_step_responses_and_a_simulated_past():
    """After random commands the move is the least-squares one of the exact future of the state."""
    A, B, C = sampled_oracle()
    law = dataclasses.replace(LAW, first=2, output_weight=[1.0, 3.0], reference=[1e-4, -2e-4])
    design = law.law(jb.state_space(beam_case(law)))
    random, x, state = np.random.default_rng(0), np.zeros(4), design.initial_state()
    u = np.zeros(2)
    for _ in range(9):
        measurement = Measurement(C @ x, np.zeros(4), u)
        command, state, _ = design.step(state, measurement, np.zeros(()))
        previous, u = u, random.normal(size=2)
        found = command - previous
        rows = expected_move(A, B, C, x, previous)
        assert_allclose(found, rows, rtol=1e-6, atol=1e-6 * np.abs(rows).max())
        x = A @ x + B @ u
    G = predicted_outputs(polynomial_model(A, B, C), 8, 3)[2]
    steps = np.cumsum([C @ np.linalg.matrix_power(A, i) @ B for i in range(8)], axis=0)
    assert_allclose(G[:, :, 0], steps, rtol=1e-8, atol=1e-12)
    assert_allclose(G[2:, :, 2], steps[:-2], rtol=1e-8, atol=1e-12)


def expected_move(A, B, C, x, command):
    """First of three moves by least squares on the exact future, from 2 to 8 samples ahead."""
    steps = np.cumsum([C @ np.linalg.matrix_power(A, i) @ B for i in range(8)], axis=0)
    free, state = [], x
    for _ in range(8):
        state = A @ state + B @ command
        free.append(C @ state)
    G = np.zeros((8, 2, 3, 2))
    for i in range(3):
        G[i:, :, i] = steps[: 8 - i]
    weight = np.sqrt(np.tile([1.0, 3.0], 7))
    error = (np.array([1e-4, -2e-4]) - np.array(free))[1:].ravel()
    rows = np.vstack([weight[:, None] * G[1:].reshape(14, 6), np.sqrt(1e-9) * np.eye(6)])
    right = np.append(weight * error, np.zeros(6))
    return np.linalg.lstsq(rows, right, rcond=None)[0][:2]


def test_a_steady_load_leaves_no_error():
    """Both deflections go to zero; at first the commands are at their limits."""
    case = beam_case(dataclasses.replace(LAW, delay=np.asarray(2e-3)))
    record = jb.simulate(case)
    still = jb.simulate(dataclasses.replace(case, controller=None))
    assert np.abs(still.deflection[-1]).min() > 1e-4
    assert np.abs(record.deflection[-1]).max() < 1e-8
    tight = jb.simulate(jb.replace(case, {"actuators.0.limits.1": 1.0}))
    assert np.mean(tight.saturated[:, 0]) > 0.2
    assert np.abs(tight.deflection[-1]).max() < np.abs(still.deflection[-1]).max()


def test_derivative_by_move_weight_and_plant():
    """Of the gains of the last reading, through the polynomials."""
    A, B, C = sampled_oracle()

    @jax.jit
    def gains(numbers):
        model = polynomial_model(A * numbers[1], B, C)
        weights = 1e-9 * numbers[0] * jnp.ones(2)
        found = predictive_gains(model, (1, 3, 1), jnp.ones(2), weights, jnp.zeros(2))
        return found.reading_gains[0].ravel() / 1e4

    found = jax.jit(jax.jacfwd(gains))(jnp.ones(2))
    expected = central(gains, np.ones(2), 1e-3)
    assert_allclose(found, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("settings", "changes", "message"),
    [
        ({"period": None}, {}, "period must be given"),
        ({"delay": 0.01}, {}, "delay must be less than the period"),
        ({"moves": 9}, {}, "moves must be at most the horizon, 8"),
        ({"reference": [0.0]}, {}, "reference must have 2 entries, not 1"),
        ({}, {"sensors": []}, "kind needs a sensor"),
        ({}, {"sensors": [jb.Sensor(0.2, "acceleration")]}, "kind needs sensors of deflection"),
    ],
)
def test_errors_of_settings(settings, changes, message):
    arrays = {k: v if v is None or k == "moves" else np.asarray(v) for k, v in settings.items()}
    with pytest.raises(ValueError, match=f"^controller.{message}"):
        check_case(beam_case(dataclasses.replace(LAW, **arrays), **changes))
