"""Designs over masses, speeds and weights at once, and their slopes by what they follow from."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.control import DiscreteLQR, ScheduledLQR
from jaxbeam.control.optimal.lqr import finite_horizon_gains
from jaxbeam.estimation import Kalman, Observer
from jaxbeam.model.modes import lay_out
from tests.differences import central

WEIGHTS = {"state_weight": [4e5, 1e5, 10.0, 1.0, 0.0], "command_weight": [1e-3]}
GRID = {"masses": [0.2, 0.4]}
LAWS = {
    "lqr": jb.LQR(**WEIGHTS),
    "dlqr": DiscreteLQR(**WEIGHTS, period=2e-3),
    "lqr-step": jb.StepLQR(**WEIGHTS, points=4),
    "lqr-finite": jb.FiniteLQR(**WEIGHTS, points=60),
    "lqr-augmented": jb.AugmentedLQR(**WEIGHTS, points=60),
    "lqr-scheduled": ScheduledLQR(**WEIGHTS, **GRID, points=60),
}
# A mass, a speed, a weight of a state, one of the command, and a number of the plant.
ADDRESSES = (
    "loads.0.mass",
    "loads.0.speed",
    "controller.state_weight.0",
    "controller.command_weight.0",
    "beam.flexural_rigidity",
)
SIZES = np.array([0.3, 4.0, 4e5, 1e-3, 11.68])
STATE = jnp.array([1e-3, -3e-4, 0.02, 0.05, 0.1])


def rig(law):
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.Shaker(0.22, 2000.0, 5.0, force_per_volt=4.6, bandwidth=500.0)],
        sensors=[jb.Sensor(0.25)],
        loads=[jb.MovingMass(mass=SIZES[0], speed=SIZES[1])],
        controller=law,
    )


def answers(name):
    """Commands to a state at three shares of the crossing, as a function of relative numbers."""
    case = rig(LAWS[name])
    layout = lay_out(case)

    def of(point):
        changed = jb.replace(case, dict(zip(ADDRESSES, point * SIZES, strict=True)))
        law, model = changed.controller, jb.state_space(changed, layout=layout)
        memory, length = law.init(model), changed.beam.length / changed.loads[0].speed

        def at(share):
            seen = Measurement(jnp.zeros(1), STATE, jnp.zeros(1))
            return law.step(memory, seen, share * length)[0][0]

        return jax.vmap(at)(jnp.array([0.13, 0.52, 0.97]))

    return of


@pytest.fixture(scope="module", params=LAWS)
def design(request):
    """Commands of a design, one at a time and many at once."""
    of = answers(request.param)
    return jax.jit(of), jax.jit(jax.vmap(of))


def test_many_at_once_are_those_designed_one_by_one(design):
    alone, together = design
    points = 1 + 0.3 * np.random.default_rng(0).uniform(-1, 1, (4, SIZES.size))
    expected = np.stack([alone(point) for point in points])
    assert_allclose(together(points), expected, rtol=1e-9)
    assert np.all(np.ptp(expected, axis=0) > 1e-3 * np.abs(expected).max(axis=0))


def test_slopes_by_loads_weights_and_plant(design):
    alone, _ = design
    at = jnp.ones(SIZES.size)
    found, expected = jax.jit(jax.jacfwd(alone))(at), central(alone, at, 2e-3)
    assert_allclose(found, expected, rtol=0, atol=1e-6 * np.max(np.abs(expected)))


ACTUATORS = {
    "at once": (jb.PointForce(0.22), 4),
    "lagging": (jb.Shaker(0.22, 2000.0, 5.0, force_per_volt=4.6, bandwidth=500.0), 5),
}


@pytest.mark.parametrize("varied", ["loads.0.mass", "controller.command_weight.0"])
@pytest.mark.parametrize("actuator", ACTUATORS)
def test_what_designs_share_makes_no_difference(actuator, varied):
    """Only one number varies from design to design; slopes in reverse, too."""
    part, states = ACTUATORS[actuator]
    law = jb.FiniteLQR(WEIGHTS["state_weight"][:states], [1e-3], points=20)
    case = dataclasses.replace(rig(law), actuators=[part])
    layout, start = lay_out(case), float(jb.addresses(case)[varied])

    def pieces(share):
        changed = jb.replace(case, {varied: share * start})
        return finite_horizon_gains(changed.controller, jb.state_space(changed, layout=layout))[
            0
        ].coefficients

    def size(share):
        return jnp.sum(pieces(share)[:, 0] ** 2)

    shares, alone = np.array([0.8, 1.0, 1.3]), jax.jit(pieces)
    expected = np.stack([alone(share) for share in shares])
    found = jax.jit(jax.vmap(pieces))(shares)
    assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    slopes = jax.jit(jax.vmap(jax.grad(size)))(shares)
    plain = jax.jit(size)
    expected = [central(lambda x: plain(x[0]), [share], step=1e-3)[0] for share in shares]
    assert_allclose(slopes, expected, rtol=1e-6)


NOISY = {
    "kalman": (Kalman(0.02, 1e-5), 2e-3),
    "kalman at every instant": (Kalman(0.02, measurement_intensity=1e-13), None),
    "observer": (Observer(speed=2.0), 2e-3),
    "observer at every instant": (Observer(speed=2.0), None),
}


@pytest.mark.parametrize("name", NOISY)
def test_gains_of_estimators_over_the_plant(name):
    """At once for many rigidities and places of the sensor, and their slopes."""
    estimator, period = NOISY[name]
    case = rig(jb.LQR(**WEIGHTS, period=period, estimator=estimator))
    layout = lay_out(case)

    def gain(point):
        values = {"beam.flexural_rigidity": 11.68 * point[0], "sensors.0.position": point[1] / 4}
        changed = jb.replace(case, values)
        model = jb.state_space(changed, layout=layout)
        found = changed.controller.estimator.init(model).gain[:4, 0]
        return found / jnp.array([1.0, 1.0, 200.0, 800.0])

    alone, points = jax.jit(gain), np.array([[1.0, 1.0], [0.8, 1.1], [1.3, 0.7]])
    expected = np.stack([alone(point) for point in points])
    together = jax.jit(jax.vmap(gain))(points)
    scale = np.abs(expected).max()
    assert_allclose(together, expected, rtol=0, atol=1e-9 * scale)
    slopes, differences = jax.jit(jax.jacfwd(gain))(points[0]), central(alone, points[0], 2e-3)
    assert_allclose(slopes, differences, rtol=0, atol=1e-6 * np.abs(differences).max())
