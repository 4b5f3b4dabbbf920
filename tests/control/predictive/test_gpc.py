"""Generalised predictive control against a published example, step responses and simulations."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.gpc import (
    PolynomialModel,
    polynomial_model,
    predicted_outputs,
    predictive_gains,
)
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


# Plants identified on line, against batch least squares and the true polynomials.

ADAPTIVE_PERIOD = 0.005
NUMBERS = {"horizon": 8, "moves": 2, "move_weight": 1e-9, "period": ADAPTIVE_PERIOD}
ADAPTIVE = jb.AdaptiveGPC(**NUMBERS, until=0.4, probe=0.5, measurement_noise=1e-7, forgetting=0.98)


def adaptive_beam_case(law, rigidity=12.0, delay=None) -> jb.Case:
    return jb.Case(
        jb.Beam(0.6, rigidity, 0.5, damping_ratio=0.02, modes=1),
        actuators=[jb.PointForce(0.3, limits=[-4.0, 4.0])],
        sensors=[jb.Sensor(0.3, delay=delay)],
        loads=[jb.MovingForce(mass=0.3, speed=2.0, entry_time=0.6)],
        controller=law,
        run=jb.Run(0.95, 200.0),
    )


def designed(law):
    return law.design_law(jb.state_space(adaptive_beam_case(law)))


def plant_by_scipy(rigidity, delay):
    """Coefficients a and b of the sampled plant at midspan, with whole periods of delay."""
    stiffness, mass = rigidity * (np.pi / 0.6) ** 4, 0.5
    omega = np.sqrt(stiffness / mass)
    continuous = [2 / (mass * 0.6)], [1.0, 0.04 * omega, omega**2]
    system = scipy.signal.cont2discrete(continuous, ADAPTIVE_PERIOD)
    numerator, denominator = np.ravel(system[0]), np.ravel(system[1])
    return denominator[1:], np.append(np.zeros(delay), numerator[1:])


def probed(law, commands, readings, state=None):
    """States of the law after each sample."""
    state, found = law.initial_state() if state is None else state, []
    for k, (command, reading) in enumerate(zip(commands, readings, strict=True)):
        measurement = Measurement(np.array([reading]), np.zeros(2), np.array([command]))
        state = law.step(state, measurement, np.asarray(k * ADAPTIVE_PERIOD)).state
        found.append(state)
    return found


def signals(samples, a, b, noise=0.0):
    """Acting commands u(k - 1), and readings by the difference equation of scipy's filter."""
    random = np.random.default_rng(3)
    commands = np.append(0.0, random.choice([-1.0, 1.0], samples - 1))
    readings = scipy.signal.lfilter(b, [1.0, *a], commands)
    return commands, readings + noise * random.normal(size=samples)


def test_true_plant_is_found_with_its_delay():
    """A beam softer by a third, with two periods of delay that the design lacks."""
    a, b = plant_by_scipy(8.0, 2)
    commands, readings = signals(60, a, b)
    law = designed(ADAPTIVE)
    model = law.model(probed(law, commands, readings)[-1])
    assert_allclose(model.denominator[:2], a, rtol=1e-3)
    assert_allclose(model.numerators[:, 0, 0], b, atol=1e-3 * np.max(b))


def test_coefficients_are_those_of_weighted_batch_least_squares():
    """With the design as prior, whose weight is forgotten too."""
    a, b = plant_by_scipy(8.0, 1)
    commands, readings = signals(12, a, b, 1e-6)
    law = designed(dataclasses.replace(ADAPTIVE, measurement_noise=1e-5))
    # The covariance is kept below that of the start; here it is not to reach it.
    unlimited = dataclasses.replace(law, start_root=1e3 * law.start_root)
    found = probed(unlimited, commands, readings, law.initial_state())[-1].coefficients
    kept = np.diag(law.start_root) > 0
    prior = np.diag(0.98**11 / np.diag(law.start_root)[kept] ** 2)
    dy, du = np.diff(readings, prepend=0.0), np.diff(commands, prepend=0.0)
    normal, right = prior, prior @ np.asarray(law.start)[kept]
    for k in range(1, 12):
        past = [dy[k - i] if k >= i else 0.0 for i in range(1, 5)]
        moves = [du[k - i] if k >= i else 0.0 for i in range(4)]
        row = np.array([-x for x in past] + moves)[kept]
        weight = 0.98 ** (11 - k) / 1e-5**2
        normal = normal + weight * np.outer(row, row)
        right = right + weight * row * dy[k]
    assert_allclose(np.asarray(found)[kept], np.linalg.solve(normal, right), rtol=1e-6)
    assert np.all(np.asarray(found)[~kept] == 0)


def test_covariance_is_capped_without_excitation():
    """Forgetting alone would make it 0.98^-400 = 3200 times that of the design in a quiet time.

    By its inverse, the information, to which a sample adds row row' / noise^2: six samples with
    moves, of which the covariance falls, then none, until it is that of the start again in trace.
    """
    law = designed(dataclasses.replace(ADAPTIVE, until=None, probe=None, measurement_noise=1e-5))
    quiet = probed(law, np.zeros(400), np.zeros(400))[-1]
    assert_allclose(quiet.root, law.start_root, rtol=1e-9)
    kept = np.diag(law.start_root) > 0
    start = (law.start_root @ law.start_root.T)[np.ix_(kept, kept)]
    commands, readings = signals(100, *plant_by_scipy(8.0, 1))
    commands[7:], readings[7:] = commands[6], readings[6]
    states = probed(law, commands, readings)
    moves, rises = np.diff(commands, prepend=0.0), np.diff(readings, prepend=0.0)
    covariance, capped = start, 0
    for k in range(1, 100):
        past = [-rises[k - i] if k >= i else 0.0 for i in (1, 2)]
        row = np.array(past + [moves[k - i] if k >= i else 0.0 for i in range(4)])
        information = 0.98 * np.linalg.inv(covariance) + np.outer(row, row) / 1e-5**2
        covariance = np.linalg.inv(information)
        excess = np.trace(covariance) / np.trace(start)
        covariance, capped = covariance / max(excess, 1.0), capped + (excess > 1)
        found = np.asarray(states[k].root @ states[k].root.T)[np.ix_(kept, kept)]
        assert_allclose(found, covariance, rtol=1e-6, atol=1e-9 * np.max(np.abs(start)))
    assert 0 < capped < 99  # both happened


def test_a_delay_that_the_design_lacks():
    """The fixed law loses the loop, the adaptive one does not."""
    peaks = []
    for law in (jb.GPC(**NUMBERS), ADAPTIVE):
        case = adaptive_beam_case(law, 8.0, 2 * ADAPTIVE_PERIOD)
        nominal = jb.state_space(adaptive_beam_case(law))
        case = eqx.tree_at(
            lambda c: c.controller.nominal_plant, case, nominal, is_leaf=lambda leaf: leaf is None
        )
        record = jb.simulate(case)
        peaks.append(np.max(np.abs(record.deflection)[record.times > 0.6]))
    free = jb.simulate(adaptive_beam_case(None, 8.0)).peak_deflection[0]
    assert peaks[0] > 2 * free and peaks[1] < 0.6 * free


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"forgetting": 1.1}, "forgetting must be at most 1"),
        ({"probe": [0.5]}, "probe needs a time to end: give until"),
        ({"probe": [0.5, 1.0], "until": 0.2}, "probe must have 1 entry, not 2"),
    ],
)
def test_errors(settings, message):
    with pytest.raises(ValueError, match=message):
        check_case(adaptive_beam_case(jb.AdaptiveGPC(**NUMBERS | settings)))
