"""Batched designs over masses, speeds and weights, and their derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.control.optimal.lqr import LQR
from jaxbeam.estimation.kalman import Kalman
from jaxbeam.estimation.observer import Observer
from jaxbeam.estimation.sampled_plant import sample_timing
from jaxbeam.model.modes import mesh_layout
from tests.differences import central

WEIGHTS = {"state_weight": [4e5, 1e5, 10.0, 1.0, 0.0], "command_weight": [1e-3]}
GRID = {"masses": [0.2, 0.4]}
LAWS = {
    "lqr": jb.LQR(**WEIGHTS),
    "dlqr": LQR(**WEIGHTS, period=2e-3, sampling="exact"),
    "lqr-step": jb.LQR(**WEIGHTS, points=4, horizon="frozen"),
    "lqr-finite": jb.LQR(**WEIGHTS, points=60, horizon="crossing"),
    "lqr-augmented": jb.LQR(**WEIGHTS, points=60, horizon="crossing", augmented="loads"),
    "lqr-scheduled": LQR(**WEIGHTS, **GRID, points=60, horizon="crossing", schedule="load"),
}
# A mass, a speed, a weight of a state, one of the command, and a parameter of the plant.
ADDRESSES = (
    "loads.0.mass",
    "loads.0.speed",
    "controller.state_weight.0",
    "controller.command_weight.0",
    "beam.flexural_rigidity",
)
SIZES = np.array([0.3, 4.0, 4e5, 1e-3, 11.68])
STATE = jnp.array([1e-3, -3e-4, 0.02, 0.05, 0.1])


def beam_case(law):
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.Shaker(0.22, 2000.0, 5.0, force_per_volt=4.6, bandwidth=500.0)],
        sensors=[jb.Sensor(0.25)],
        loads=[jb.MovingMass(mass=SIZES[0], speed=SIZES[1])],
        controller=law,
    )


def commands_of(name):
    """Function from relative numbers to commands for a state at three shares of the crossing."""
    case = beam_case(LAWS[name])
    layout = mesh_layout(case)

    def commands(point):
        changed = jb.replace(case, dict(zip(ADDRESSES, point * SIZES, strict=True)))
        law = changed.controller.law(jb.state_space(changed, layout=layout))
        crossing_time = changed.beam.length / changed.loads[0].speed

        def command(share):
            measurement, t = Measurement(jnp.zeros(1), STATE, jnp.zeros(1)), share * crossing_time
            if changed.controller.period is None:
                return law.command(jnp.zeros(0), measurement, t)[0]
            return law.step(law.initial_state(), measurement, t).command[0]

        return jax.vmap(command)(jnp.array([0.13, 0.52, 0.97]))

    return commands


@pytest.fixture(scope="module", params=LAWS)
def design(request):
    """Commands of a design: single, and batched."""
    commands = commands_of(request.param)
    return jax.jit(commands), jax.jit(jax.vmap(commands))


def test_batched_designs_equal_single_ones(design):
    single, batched = design
    points = 1 + 0.3 * np.random.default_rng(0).uniform(-1, 1, (4, SIZES.size))
    expected = np.stack([single(point) for point in points])
    assert_allclose(batched(points), expected, rtol=1e-9)
    assert np.all(np.ptp(expected, axis=0) > 1e-3 * np.abs(expected).max(axis=0))


def test_derivatives_by_loads_weights_and_plant(design):
    single, _ = design
    at = jnp.ones(SIZES.size)
    found, expected = jax.jit(jax.jacfwd(single))(at), central(single, at, 2e-3)
    assert_allclose(found, expected, rtol=0, atol=1e-6 * np.max(np.abs(expected)))


ACTUATORS = {
    "direct": (jb.PointForce(0.22), 4),
    "lagging": (jb.Shaker(0.22, 2000.0, 5.0, force_per_volt=4.6, bandwidth=500.0), 5),
}


@pytest.mark.parametrize("varied", ["loads.0.mass", "controller.command_weight.0"])
@pytest.mark.parametrize("actuator", ACTUATORS)
def test_batched_designs_with_shared_parameters(actuator, varied):
    """Only one parameter varies; reverse-mode derivatives too."""
    part, states = ACTUATORS[actuator]
    law = jb.LQR(WEIGHTS["state_weight"][:states], [1e-3], points=20, horizon="crossing")
    case = dataclasses.replace(beam_case(law), actuators=[part])
    layout, start = mesh_layout(case), float(jb.addresses(case)[varied])

    def coefficients(share):
        changed = jb.replace(case, {varied: share * start})
        return changed.controller.crossing_gains(jb.state_space(changed, layout=layout))[
            0
        ].coefficients

    def size(share):
        return jnp.sum(coefficients(share)[:, 0] ** 2)

    shares, single = np.array([0.8, 1.0, 1.3]), jax.jit(coefficients)
    expected = np.stack([single(share) for share in shares])
    found = jax.jit(jax.vmap(coefficients))(shares)
    assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    derivatives = jax.jit(jax.vmap(jax.grad(size)))(shares)
    compiled_size = jax.jit(size)
    expected = [central(lambda x: compiled_size(x[0]), [share], step=1e-3)[0] for share in shares]
    assert_allclose(derivatives, expected, rtol=1e-6)


ESTIMATORS = {
    "kalman": (Kalman(0.02, 1e-5), 2e-3),
    "kalman, continuous": (Kalman(0.02, measurement_intensity=1e-13), None),
    "observer": (Observer(speed=2.0), 2e-3),
    "observer, continuous": (Observer(speed=2.0), None),
}


@pytest.mark.parametrize("name", ESTIMATORS)
def test_gains_of_estimators_over_the_plant(name):
    """Batched over rigidities and positions of the sensor, and their derivatives."""
    estimator, period = ESTIMATORS[name]
    case = beam_case(jb.LQR(**WEIGHTS, period=period, estimator=estimator))
    layout = mesh_layout(case)

    def gain(point):
        values = {"beam.flexural_rigidity": 11.68 * point[0], "sensors.0.position": point[1] / 4}
        changed = jb.replace(case, values)
        model = jb.state_space(changed, layout=layout)
        controller = changed.controller
        if period is None:
            filter = controller.estimator.continuous_filter(model)
        else:
            filter = controller.estimator.sampled_filter(model, sample_timing(controller))
        return filter.gain[:4, 0] / jnp.array([1.0, 1.0, 200.0, 800.0])

    single, points = jax.jit(gain), np.array([[1.0, 1.0], [0.8, 1.1], [1.3, 0.7]])
    expected = np.stack([single(point) for point in points])
    batched = jax.jit(jax.vmap(gain))(points)
    scale = np.abs(expected).max()
    assert_allclose(batched, expected, rtol=0, atol=1e-9 * scale)
    derivatives, differences = (
        jax.jit(jax.jacfwd(gain))(points[0]),
        central(single, points[0], 2e-3),
    )
    assert_allclose(derivatives, differences, rtol=0, atol=1e-6 * np.abs(differences).max())
