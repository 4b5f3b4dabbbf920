"""Regulator with integral action against scipy, and its readings at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.estimator import Estimate
from jaxbeam.case.validation import check_case
from tests.differences import central
from tests.loop_as_oracle import span_of

PERIOD, PLACE, SENSOR, MODES = 0.004, 0.22, 0.3, 2
STATES, COMMAND, INTEGRAL, REFERENCE = [1e4, 1e4, 1.0, 1.0], [1e-2], [1e9], [1e-4]


def tracking(**settings) -> jb.LQR:
    given = {"integral_weight": INTEGRAL, "reference": REFERENCE, "period": PERIOD} | settings
    return jb.LQR(STATES, COMMAND, **given, sampling="exact")


def beam_case(law, loads=(), limits=None, duration=2.0) -> jb.Case:
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=MODES),
        actuators=[jb.PointForce(PLACE, limits=limits)],
        sensors=[jb.Sensor(SENSOR)],
        loads=list(loads),
        controller=law,
        run=jb.Run(duration, 250.0),
    )


def expected_gain():
    """Gain of the sampled plant with the sum of errors, its cost by fine quadrature."""
    span = span_of(beam_case(tracking()))
    A = np.zeros((2 * MODES, 2 * MODES))
    A[:MODES, MODES:], A[MODES:, :MODES] = np.eye(MODES), -np.diag(span.frequencies**2)
    A[MODES:, MODES:] = -span.damping
    B = np.append(np.zeros(MODES), span.shapes(PLACE))[:, None]
    held = np.zeros((2 * MODES + 1, 2 * MODES + 1))
    held[:-1] = np.hstack([A, B])
    rate = scipy.linalg.block_diag(np.diag(STATES), np.diag(COMMAND))
    nodes, weights = np.polynomial.legendre.leggauss(12)
    cost = np.zeros_like(held)
    for node, weight in zip(nodes, weights, strict=True):
        part = scipy.linalg.expm(held * PERIOD * (1 + node) / 2)
        cost += weight * PERIOD / 2 * part.T @ rate @ part
    whole = scipy.linalg.expm(held * PERIOD)
    output = np.append(span.shapes(SENSOR), np.zeros(MODES))
    n = 2 * MODES
    sampled = np.block([[whole[:n, :n], np.zeros((n, 1))], [PERIOD * output, np.ones((1, 1))]])
    inputs = np.append(whole[:n, n], 0.0)[:, None]
    Q = scipy.linalg.block_diag(cost[:n, :n], PERIOD * np.diag(INTEGRAL))
    R, N = cost[n:, n:], np.append(cost[:n, n], 0.0)[:, None]
    P = scipy.linalg.solve_discrete_are(sampled, inputs, Q, R, s=N)
    return np.linalg.solve(R + inputs.T @ P @ inputs, inputs.T @ P @ sampled + N.T)


def test_gain_against_scipy():
    plant = jb.state_space(beam_case(tracking()))
    found, expected = tracking().time_invariant_gain(plant), expected_gain()
    assert_allclose(found, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())


def test_the_reading_reaches_its_reference_under_an_unknown_load():
    load = jb.MovingForce(mass=0.2, speed=0.5, deceleration=0.625)  # stops at 0.2 m, after 0.8 s
    case = beam_case(tracking(delay=0.0015), [load], duration=1.4)
    record = jb.simulate(case)
    assert_allclose(record.deflection[-25:, 0], REFERENCE[0], atol=1e-8)
    command_of_load = np.asarray(record.command)[-1, 0]
    assert command_of_load > 1.5 * 0.2 * 9.81 / 4  # it lifts the load too


def test_the_integral_stands_still_beyond_the_limits():
    """A reference out of reach does not wind up."""
    far = tracking(reference=[1e-2])
    case = beam_case(far, limits=[-2.0, 2.0], duration=0.2)
    record = jb.simulate(case)
    assert_allclose(np.asarray(record.command)[20:, 0], 2.0)
    plant = jb.state_space(case)
    law, state = far.design_state_law(plant, plant), np.zeros(1)
    rest = Estimate(np.zeros(2 * MODES)), Measurement(np.zeros(1), np.zeros(4), np.zeros(1))
    for _ in range(1000):
        state = law.step(state, *rest, np.zeros(())).state
    assert_allclose(state, -PERIOD * 1e-2)  # of the first sample, whose command is beyond


def test_derivative_by_the_weight_of_the_integral():
    plant = jb.state_space(beam_case(tracking()))

    def gain(logarithm):
        law = tracking(integral_weight=jnp.asarray(INTEGRAL) * jnp.exp(logarithm))
        return law.time_invariant_gain(plant)[0]

    found, expected = jax.jacfwd(gain)(0.0), central(gain, 0.0, 1e-3)[:, 0]
    assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"period": None}, "period must be given"),
        ({"reference": [0.0, 0.0]}, "integral_weight must have an entry for each of 2 reference"),
        (
            {"reference": [0.0, 0.0], "integral_weight": [1.0, 1.0]},
            "reference must have at most 1 entries",
        ),
        ({"delay": 0.01}, "delay must be less than the period"),
    ],
)
def test_errors_of_settings(settings, message):
    with pytest.raises(ValueError, match=f"^controller.{message}"):
        check_case(beam_case(tracking(**settings)))
