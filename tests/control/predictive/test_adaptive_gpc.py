"""Plants identified on line, against batch least squares and the true polynomials."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.predictive.gpc import PolynomialModel, lift_and_delay
from tests.differences import central

PERIOD = 0.005
NUMBERS = {"horizon": 8, "moves": 2, "move_weight": 1e-9, "period": PERIOD}
ADAPTIVE = jb.AdaptiveGPC(**NUMBERS, until=0.4, probe=0.5, measurement_noise=1e-7, forgetting=0.98)


def beam_case(law, rigidity=12.0, delay=None) -> jb.Case:
    return jb.Case(
        jb.Beam(0.6, rigidity, 0.5, damping_ratio=0.02, modes=1),
        actuators=[jb.PointForce(0.3, limits=[-4.0, 4.0])],
        sensors=[jb.Sensor(0.3, delay=delay)],
        loads=[jb.MovingForce(mass=0.3, speed=2.0, entry_time=0.6)],
        controller=law,
        run=jb.Run(0.95, 200.0),
    )


def designed(law):
    return law.design_law(jb.state_space(beam_case(law)))


def plant_by_scipy(rigidity, delay):
    """Coefficients a and b of the sampled plant at midspan, with whole periods of delay."""
    stiffness, mass = rigidity * (np.pi / 0.6) ** 4, 0.5
    omega = np.sqrt(stiffness / mass)
    continuous = [2 / (mass * 0.6)], [1.0, 0.04 * omega, omega**2]
    system = scipy.signal.cont2discrete(continuous, PERIOD)
    numerator, denominator = np.ravel(system[0]), np.ravel(system[1])
    return denominator[1:], np.append(np.zeros(delay), numerator[1:])


def probed(law, commands, readings, state=None):
    """States of the law after each sample."""
    state, found = law.initial_state() if state is None else state, []
    for k, (command, reading) in enumerate(zip(commands, readings, strict=True)):
        measurement = Measurement(np.array([reading]), np.zeros(2), np.array([command]))
        state = law.step(state, measurement, np.asarray(k * PERIOD)).state
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
    lift, delay = lift_and_delay(model)
    assert_allclose(lift, np.sum(b) / (1 + np.sum(a)), rtol=2e-3)
    # Behind the delay: half a period of holding, and the lag 2 zeta / omega of the mode.
    omega = np.sqrt(8.0 / 0.5) * (np.pi / 0.6) ** 2
    assert_allclose(delay, 2 + 0.5 + 0.04 / omega / PERIOD, rtol=1e-2)


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


def test_lift_and_delay_of_a_pure_delay():
    model = PolynomialModel(np.zeros(4), np.array([0.0, 0.0, 2.0, 0.0]).reshape(4, 1, 1))
    assert_allclose(np.ravel(lift_and_delay(model)), [2.0, 3.0])


def test_a_delay_that_the_design_lacks():
    """The fixed law loses the loop, the adaptive one does not."""
    peaks = []
    for law in (jb.GPC(**NUMBERS), ADAPTIVE):
        case = beam_case(law, 8.0, 2 * PERIOD)
        nominal = jb.state_space(beam_case(law))
        case = eqx.tree_at(
            lambda c: c.controller.nominal_plant, case, nominal, is_leaf=lambda leaf: leaf is None
        )
        record = jb.simulate(case)
        peaks.append(np.max(np.abs(record.deflection)[record.times > 0.6]))
    free = jb.simulate(beam_case(None, 8.0)).peak_deflection[0]
    assert peaks[0] > 2 * free and peaks[1] < 0.6 * free


def test_derivatives_through_identification():
    a, b = plant_by_scipy(8.0, 1)
    commands, readings = signals(5, a, b)

    def command(point):
        law = dataclasses.replace(
            designed(dataclasses.replace(ADAPTIVE, until=None, probe=None)), noise=1e-5 * point[0]
        )
        state = law.initial_state()
        for k, (u, y) in enumerate(zip(commands, readings, strict=True)):
            measured = Measurement(point[1] * np.array([y]), np.zeros(2), np.array([u]))
            last = law.step(state, measured, np.asarray(k * PERIOD))
            state = last.state
        return last.command

    differences = central(command, np.ones(2), 1e-3)
    assert_allclose(jax.jacfwd(command)(jnp.ones(2)), differences, rtol=1e-5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"forgetting": 1.1}, "forgetting must be at most 1"),
        ({"probe": [0.5]}, "probe needs a time to end: give until"),
        ({"probe": [0.5, 1.0], "until": 0.2}, "probe must have 1 entries, not 2"),
    ],
)
def test_errors(settings, message):
    with pytest.raises(ValueError, match=message):
        check_case(beam_case(jb.AdaptiveGPC(**NUMBERS | settings)))
