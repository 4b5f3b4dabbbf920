"""Moving-horizon estimation: against bounded least squares over all states, and Kalman filters."""

import dataclasses
import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.estimation.inversion import Inversion
from jaxbeam.control.estimation.kalman import Kalman
from jaxbeam.control.estimation.observability import ConditioningWarning, conditioning
from jaxbeam.control.estimation.observer import Observer
from jaxbeam.control.estimation.sampled_plant import sample_timing
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.model.modes import mesh_layout
from tests.control.estimation.test_kalman import (
    CASE,
    DEVIATION,
    ESTIMATED,
    FORCES,
    NOISE,
    OFFSET,
    PERIOD as HORIZON_PERIOD,
    oracle,
    signals,
)
from tests.control.predictive.test_mpc_exact import affine, by_clarabel
from tests.differences import central
from tests.loop_as_oracle import span_of

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
    filter = filter.tabulated(HORIZON_PERIOD * np.arange(len(readings)))
    state, found = filter.initial_state(), []
    for k, (command, reading) in enumerate(zip(commands, readings, strict=True)):
        measurement = Measurement(reading, np.zeros(5), command)
        estimate, state = filter.update(state, measurement, np.asarray(k * HORIZON_PERIOD))
        found.append(estimate)
    return found


@pytest.mark.parametrize("actuator", [CASE.actuators[0], jb.PointForce(0.4)])
def test_without_bounds_that_matter_it_is_the_kalman_filter(actuator):
    """Accelerations answer to the command of a force at once, to that of a shaker later."""
    case = dataclasses.replace(CASE, actuators=(actuator,))
    assert np.any(jb.state_space(case).unloaded.D) == isinstance(actuator, jb.PointForce)
    for found, expected in zip(
        estimates(moving_horizon(**WIDE), case), estimates(ESTIMATED, case), strict=True
    ):
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


def test_the_bound_of_the_weight_of_a_vehicle_moves_all_states_with_it():
    """x + P_w (bound - x_w) / P_ww, of the mean x and covariance P of a Kalman filter."""
    car = jb.QuarterCar(0.3, 0.1, 400.0, 1.0, 2e3, 0.0, speed=0.5, entry_time=-0.4)
    case = dataclasses.replace(CASE, loads=(car,))
    plant = jb.state_space(case)
    filter = ESTIMATED.sampled_filter(plant, sample_timing(case.controller))
    state = filter.initial_state()
    for k, (command, reading) in enumerate(zip(*signals(SAMPLES), strict=True)):
        measurement = Measurement(reading, np.zeros(5), command)
        estimate, state = filter.update(state, measurement, np.asarray(k * HORIZON_PERIOD))
    (weight,) = np.flatnonzero(state.x == estimate.weights)
    bound = estimate.weights[0] + 1.0
    column = state.covariance[:, weight] / state.covariance[weight, weight]
    found = estimates(moving_horizon(min_weight=bound), case)[-1]
    assert_allclose(found.weights, bound, rtol=1e-7)
    expected = (state.x + column)[: found.state.size]
    scale = np.max(np.abs(column[: found.state.size]))
    assert_allclose(found.state, expected, rtol=1e-6, atol=1e-6 * scale)


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
    law = jb.LQR([1.0] * 5, [1.0], period=HORIZON_PERIOD, estimator=jb.MovingHorizon(**numbers))
    with pytest.raises(ValueError, match=words):
        check_case(dataclasses.replace(CASE, controller=law))


# Inversion of mode shapes against numpy and scipy; errors and warnings of sets of sensors.

PERIOD = 2e-3


def loop(positions, estimator=None, modes=3, quantity="deflection", design=None):
    count = modes if design is None or design.modes is None else design.modes
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=modes),
        actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0)],
        sensors=[jb.Sensor(x, quantity, offset=1e-4) for x in positions],
        controller=jb.StateFeedback(
            np.zeros((1, 2 * count + 1)),
            period=PERIOD,
            delay=5e-4,
            estimator=Inversion(time_constant=0.01) if estimator is None else estimator,
            design=design,
        ),
    )


def inversion_estimates(case, readings, commands):
    """States (sample, state) by the inversion, from readings and commands (sample, ...)."""
    controller, layout = case.controller, mesh_layout(case)

    @jax.jit
    def run(case):
        plant = jb.state_space(case, layout=layout)
        filter = controller.estimator.sampled_filter(plant, sample_timing(controller))

        def update(state, sample):
            measurement = Measurement(sample[0], jnp.zeros(0), sample[1])
            estimate, state = filter.update(state, measurement, jnp.zeros(()))
            return state, estimate.state

        samples = jnp.asarray(readings), jnp.asarray(commands)
        return jax.lax.scan(update, filter.initial_state(), samples)[1]

    return np.asarray(run(case))


@pytest.mark.parametrize(
    "positions", [[0.15, 0.25, 0.35], [0.1, 0.2, 0.3, 0.45, 0.5], [0.15, 0.25]], ids=len
)
def test_coordinates_rates_and_states_of_actuators(positions):
    """Exact, least-squares or least-norm coordinates; rates by scipy's filter of differences."""
    case = loop(positions)
    random = np.random.default_rng(len(positions))
    readings = 1e-3 * random.normal(size=(40, len(positions))) + 1e-4
    commands = random.normal(size=(40, 1))
    found = inversion_estimates(case, readings, commands)
    rows = span_of(case).shapes(np.array(positions))
    modal = np.linalg.lstsq(rows, (readings - 1e-4).T, rcond=None)[0].T
    assert_allclose(found[:, :3], modal, rtol=1e-9, atol=1e-12)
    lag = np.exp(-PERIOD / 0.01)
    numerator = (1 - lag) / PERIOD * np.array([1.0, -1.0])
    rates = scipy.signal.lfilter(numerator, [1.0, -lag], modal, axis=0)
    assert_allclose(found[:, 3:6], rates, rtol=1e-9, atol=1e-9)
    # Lag of the shaker: the previous command acts for 0.5 ms, then the one of the sample.
    lagged, previous = 0.0, 0.0
    for command, state in zip(commands[:, 0], found[:, 6], strict=True):
        lagged = previous + (lagged - previous) * np.exp(-400.0 * 5e-4)
        lagged = command + (lagged - command) * np.exp(-400.0 * (PERIOD - 5e-4))
        assert state == pytest.approx(lagged, rel=1e-9)
        previous = command


def test_conditioning():
    """Ratio of singular values, and its gradient by the positions of sensors."""
    case = loop([0.15, 0.25, 0.35])

    @jax.jit
    def condition_number(positions):
        moved = {f"sensors.{i}.position": positions[i] for i in range(3)}
        model = jb.state_space(jb.replace(case, moved), layout=mesh_layout(case))
        return conditioning(model.unloaded)

    at = jnp.array([0.15, 0.25, 0.35])
    shapes = span_of(case).shapes(np.asarray(at))
    assert_allclose(condition_number(at), np.linalg.cond(shapes), rtol=1e-10)
    expected = central(condition_number, at, 1e-3)
    assert_allclose(jax.grad(condition_number)(at), expected, rtol=1e-6)


THIRD = 0.2  # m, a node of the third mode
ERRORS = [
    (loop([0.3, 0.3, 0.3]), "kind needs sensors of deflection that distinguish all 3 modes"),
    (loop([THIRD, 2 * THIRD]), "kind needs sensors of deflection that distinguish all 3 modes"),
    (loop([0.1], quantity="velocity"), "kind needs sensors of deflection; add one"),
    (
        jb.replace(loop([THIRD, 2 * THIRD], Kalman(1e-2, 1e-5)), {"beam.damping_ratio": 0.0}),
        "kind needs sensors that observe every mode without damping: none of 2 observes the one at",
    ),
    (
        loop([THIRD], Observer(speed=2.0), quantity="acceleration"),
        "kind needs sensors that observe every mode: none of 1 observes the one at",
    ),
    (loop([], Kalman(1e-2, 1e-5)), "kind needs sensors; add one"),
    (loop([0.1], Kalman(1e-2)), "measurement_noise must be given, as sensors.0 has no noise"),
    (loop([0.1], Kalman([1.0, 2.0], 1e-5)), "process_noise must be one number or 3, not 2"),
    (loop([0.1], Kalman(1e-2, [1.0, 2.0])), "measurement_noise must be one number or 1, not 2"),
    (loop([0.1], Kalman(-1e-2, 1e-5)), "process_noise must be positive"),
    (loop([0.1], Kalman(1e-2, 1e-5, loads="known")), "loads must be 'ignored': there are none"),
    (
        loop([0.1], Kalman(1e-2, 1e-5, weight_deviation=1.0)),
        "weight_deviation and loads = 'estimated' belong together",
    ),
]


@pytest.mark.parametrize(("case", "message"), ERRORS)
def test_errors_of_sets_of_sensors(case, message):
    with pytest.raises(ValueError, match=f"^controller.estimator.{message}"):
        check_case(case)


def test_sensors_near_a_node_warn():
    case = loop([THIRD + 2e-4, 2 * THIRD, 0.1995])
    with pytest.warns(
        ConditioningWarning, match="modes are ill-conditioned at the sensors of deflection"
    ):
        check_case(case)


def test_sensors_on_nodes_of_modes_outside_the_design():
    """No error and no warning; case files keep the estimator."""
    case = loop([THIRD, 2 * THIRD], Kalman(1e-2, 1e-5), design=DesignModel(modes=2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_case(case)
    restored = case_from_dict(case_to_dict(case))
    assert case_to_dict(restored) == case_to_dict(case)
    assert case_to_dict(case)["controller"]["estimator"]["kind"] == "kalman"
