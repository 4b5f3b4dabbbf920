"""Moving-horizon estimation: against bounded least squares over all states, and Kalman filters."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.estimation.sampled_plant import sample_timing
from jaxbeam.model.modes import mesh_layout
from tests.control.predictive.test_mpc_exact import affine, by_clarabel
from tests.differences import central
from tests.estimation.test_kalman import (
    CASE,
    DEVIATION,
    ESTIMATED,
    FORCES,
    NOISE,
    OFFSET,
    PERIOD,
    oracle,
    signals,
)

SAMPLES = 8
WIDE = {"min_weight": -1e3, "deflection_limit": 1.0}
POSITIONS = np.array([0.15, 0.25, 0.35, 0.45])


def moving_horizon(**bounds) -> jb.MovingHorizon:
    return jb.MovingHorizon(FORCES, weight_deviation=DEVIATION, **bounds)


def estimates(estimator, case=CASE, layout=None, readings=None, commands=None):
    """Estimates at all samples."""
    drawn = signals(SAMPLES)
    commands, readings = (
        part if given is None else given
        for part, given in zip(drawn, (commands, readings), strict=True)
    )
    plant = jb.state_space(case, layout=layout)
    filter = estimator.sampled_filter(plant, sample_timing(case.controller))
    filter = filter.tabulated(PERIOD * np.arange(len(readings)))
    state, found = filter.initial_state(), []
    for k, (command, reading) in enumerate(zip(commands, readings, strict=True)):
        measurement = Measurement(reading, np.zeros(5), command)
        estimate, state = filter.update(state, measurement, np.asarray(k * PERIOD))
        found.append(estimate)
    return found


def test_without_bounds_that_matter_it_is_the_kalman_filter():
    pairs = zip(estimates(moving_horizon(**WIDE)), estimates(ESTIMATED), strict=True)
    for found, expected in pairs:
        scale = np.max(np.abs(expected.state))
        assert_allclose(found.state, expected.state, rtol=1e-9, atol=1e-9 * scale)
        assert_allclose(found.weights, expected.weights, rtol=1e-9)


class Batch:
    """All states from standard normal numbers: weight of the load, then noise of each step."""

    def __init__(self):
        self.steps, self.rows = oracle(CASE, SAMPLES)
        self.roots = []
        for step in self.steps:
            values, vectors = np.linalg.eigh(step.noise)
            self.roots.append(vectors * np.sqrt(np.maximum(values, 0)))
        self.count = 1 + 6 * SAMPLES
        angles = np.pi * np.outer(POSITIONS, [1, 2]) / 0.6
        self.shapes = np.sin(angles) * np.sqrt(2 / (0.535 * 0.6))

    def states(self, numbers, commands):
        x, before, found = np.zeros(6), np.zeros(1), []
        x[-1] = 0.4 * 9.81 + DEVIATION * numbers[0]
        parts = zip(self.steps, self.roots, numbers[1:].reshape(-1, 6), commands, strict=True)
        for step, root, noise, command in parts:
            x = step.transition @ x + step.before @ before + step.after @ command + root @ noise
            before = command
            found.append(x)
        return np.array(found)

    def most_probable(self, commands, readings, window, limit, least):
        """Last state of the most probable motion within bounds, by Clarabel."""

        def residuals(numbers):
            states = self.states(numbers, commands)
            found = [
                (C @ x + D @ u - y) / NOISE
                for (C, D), x, u, y in zip(self.rows, states, commands, readings, strict=True)
            ]
            return np.append(numbers, found)

        def bounded(numbers):
            states = self.states(numbers, commands)
            deflections = 1e4 * (states[-window:, :2] @ self.shapes.T).ravel()
            bound = 1e4 * limit
            return np.concatenate(
                [deflections - bound, -deflections - bound, [least - states[-1, -1]]]
            )

        start, slopes = affine(residuals, self.count)
        sides, rows = affine(bounded, self.count)
        best = by_clarabel(2 * slopes.T @ slopes, 2 * slopes.T @ start, rows, -sides)
        return self.states(best, commands)[-1], np.max(sides + rows @ best)


@functools.cache
def batch() -> Batch:
    return Batch()


@pytest.mark.parametrize(
    ("window", "limit", "least"), [(1, 1.0, 7.5), (1, 8e-6, -9.0), (4, 5e-6, -9.0), (4, 5e-6, 7.5)]
)
def test_estimates_are_the_most_probable_within_bounds(window, limit, least):
    """The window before the bounds counts by the filter; deflections of the window are bounded."""
    commands, readings = signals(SAMPLES)
    bounds = {"window": window, "deflection_limit": limit, "min_weight": least}
    found = estimates(moving_horizon(**bounds))[-1]
    expected, nearest = batch().most_probable(commands, readings - OFFSET, window, limit, least)
    free = estimates(ESTIMATED)[-1]
    assert abs(nearest) < 1e-5, "a bound is met"
    state = np.append(found.state, found.weights)
    unbounded = np.append(free.state, free.weights)
    size = np.max(np.abs(expected - unbounded)[[0, 1, 2, 3, 5]])
    assert size > 1e-3
    scale = np.abs(unbounded) + np.abs(expected - unbounded)
    assert_allclose((state - expected) / scale, 0.0, atol=2e-4)


def test_the_weight_of_a_light_load_in_much_noise_is_closer_to_the_truth():
    """Means of squared errors over 20 draws of a load of 0.02 kg and noise of its deflection."""
    case = dataclasses.replace(
        CASE,
        beam=jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=1),
        actuators=(),
        sensors=(jb.Sensor(0.3),),
        loads=(jb.MovingForce(mass=0.02, speed=6.0),),
        controller=jb.Prescribed([], period=0.005),
    )
    noise = {"process_noise": 1e-4, "measurement_noise": 1e-3, "weight_deviation": 1.0}
    design = dataclasses.replace(case, loads=(jb.MovingForce(mass=0.05, speed=6.0),))
    times = 0.005 * np.arange(18)
    truth = jb.simulate(dataclasses.replace(case, controller=None, run=jb.Run(0.1)), times)
    random, errors = np.random.default_rng(4), []
    filters = [
        kind.sampled_filter(jb.state_space(design), sample_timing(case.controller)).tabulated(times)
        for kind in (jb.MovingHorizon(**noise), jb.Kalman(**noise, loads="estimated"))
    ]
    for _ in range(20):
        readings = truth.deflection + 1e-3 * random.normal(size=(18, 1))
        last = []
        for filter in filters:
            state, estimate = filter.initial_state(), None
            for t, reading in zip(times, readings, strict=True):
                measurement = Measurement(reading, np.zeros(2), np.zeros(0))
                estimate, state = filter.update(state, measurement, t)
            assert estimate is not None
            last.append(estimate.weights[0] - 0.02 * 9.81)
        errors.append(last)
    bounded, free = np.mean(np.square(errors), axis=0)
    assert bounded < 0.7 * free


@pytest.mark.parametrize("bounds", [{"min_weight": 15.0}, {"deflection_limit": 5e-6, "window": 3}])
def test_derivatives_where_a_bound_is_met(bounds):
    """By noise of the forces, mass, readings and the bound, forward."""
    layout = mesh_layout(CASE)
    commands, readings = (part[:3] for part in signals(SAMPLES))
    (name, bound), *_ = bounds.items()

    def last(point):
        case = jb.replace(CASE, {"loads.0.mass": 0.4 * point[0]})
        numbers = bounds | {name: bound * point[1]}
        estimator = jb.MovingHorizon(FORCES * point[2], weight_deviation=DEVIATION, **numbers)
        found = estimates(estimator, case, layout, readings * point[3], commands)[-1]
        return found.state[2:4] * 1e4

    point = np.ones(4)
    expected = central(last, point, 1e-4)
    assert np.max(np.abs(expected[:, 1])) > 1e-3, "the bound matters"
    found = jax.jit(jax.jacfwd(last))(point)
    assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * np.max(np.abs(expected)))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"max_weight": 0.0}, "max_weight must be above min_weight, 0 N, not 0 N"),
        ({"weight_deviation": None}, "weight_deviation and loads = 'estimated' belong together"),
        ({"deflection_limit": 0.0}, "deflection_limit must be positive"),
        ({"loads": "ignored"}, "loads cannot be 'ignored'"),
        ({"window": 0}, "window"),
    ],
)
def test_errors(settings, words):
    numbers = {"process_noise": FORCES, "weight_deviation": 1.0} | settings
    law = jb.LQR([1.0] * 5, [1.0], period=PERIOD, estimator=jb.MovingHorizon(**numbers))
    with pytest.raises(ValueError, match=words):
        check_case(dataclasses.replace(CASE, controller=law))
