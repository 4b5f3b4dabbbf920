"""Gradients of metrics of compiled run sets through closed loops, against differences.

The derivatives of runs by every number of every kind are in `tests/simulation/test_every_number`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
import tuning
from tests.differences import central
from tuning.control.run_set import make_run_set

RUNS = tuning.full_grid({"loads.0.mass": [0.3], "loads.0.speed": [1.5]})
REGULATOR = {"state_weight": [1e4, 1.0], "command_weight": [1e-3], "period": 0.01}
LOOPS = {
    "feedback": (
        jb.Feedback([3000.0], period=0.01, delay=0.004),
        {
            "controller.gains.0": 3000.0,
            "sensors.0.filter.cutoff": 20.0,
            "sensors.0.position": 0.25,
            "actuators.0.start": 0.2575,
            "actuators.0.end": 0.3425,
        },
    ),
    "output feedback": (
        jb.OutputFeedback([[-3000.0]], period=0.01),
        {"controller.gains.0.0": -3000.0},
    ),
    "regulator": (
        jb.LQR(
            estimator=jb.Kalman(process_noise=0.02, measurement_noise=1e-5),
            **REGULATOR,
        ),
        {
            "controller.state_weight.0": 1e4,
            "controller.command_weight.0": 1e-3,
            "controller.estimator.process_noise": 0.02,
        },
    ),
    "sampled regulator": (
        jb.LQR(**REGULATOR, sampling="exact"),
        {"controller.state_weight.0": 1e4, "controller.command_weight.0": 1e-3},
    ),
    "finite": (
        jb.LQR(**REGULATOR, points=24, horizon="crossing"),
        {"controller.state_weight.0": 1e4, "controller.command_weight.0": 1e-3},
    ),
    "scheduled": (
        jb.LQR(
            **REGULATOR,
            points=24,
            masses=[0.2, 0.4],
            speeds=[1.0, 2.0],
            horizon="crossing",
            schedule="load",
        ),
        {"controller.state_weight.0": 1e4, "controller.masses.0": 0.2},
    ),
}


def rig(controller):
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, damping_ratio=0.03, modes=1),
        actuators=[jb.Patch(0.2575, 0.3425, 8.292e-4, correction=0.32, amplifier_gain=200.0)],
        sensors=[jb.Sensor(0.25, filter=jb.Filter(cutoff=20.0, order=2, realisation="analogue"))],
        loads=[jb.MovingMass(mass=0.5, speed=1.5)],
        controller=controller,
        run=jb.Run(duration=0.5, sample_rate=100.0),
    )


@pytest.mark.parametrize("kind", LOOPS)
def test_gradients_through_the_closed_loop(kind):
    controller, start = LOOPS[kind]
    case = rig(controller)
    if kind != "feedback":  # without the filter it compiles faster
        case = dataclasses.replace(case, sensors=[jb.Sensor(0.25)])
    run_set = make_run_set(case, RUNS)
    sizes = np.array(list(start.values()))

    @jax.jit
    @jax.value_and_grad
    def objective(shares):
        values = dict(zip(start, shares * sizes, strict=True))
        metrics = run_set.metrics(values, 50.0)
        return metrics["peak"][0] + 0.1 * metrics["effort"][0]

    ones = np.ones(sizes.size)
    gradient = objective(jnp.asarray(ones))[1]
    expected = central(lambda shares: objective(shares)[0], ones, step=1e-4)
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())
    assert np.all(np.abs(expected) > 1e-7)


def test_gradients_of_a_bending_moment():
    """The metric is of the statically corrected moment that records have."""
    case = rig(jb.Feedback([3000.0], period=0.02))
    sensors = (jb.Sensor(0.25), jb.Sensor(0.15, "moment"))
    case = dataclasses.replace(case, sensors=sensors, run=jb.Run(0.42, sample_rate=50.0))
    run_set = make_run_set(case, RUNS, [0.25], quantities=("moment",))

    @jax.jit
    @jax.value_and_grad
    def metric(gain):
        return run_set.metrics({"controller.gains.0": gain}, 50.0)["moment"][0]

    value, slope = metric(jnp.asarray(3000.0))
    controlled, uncontrolled = (
        np.abs(jb.simulate(jb.replace(one, RUNS[0])).sensor_values[:, 1])
        for one in (case, dataclasses.replace(case, controller=None))
    )
    expected = np.log(np.sum(np.exp(50.0 * controlled / uncontrolled.max()))) / 50.0
    np.testing.assert_allclose(value, expected, rtol=1e-4)
    above, below = (metric(jnp.asarray(3000.0 + h))[0] for h in (10.0, -10.0))
    np.testing.assert_allclose(slope, (above - below) / 20, rtol=1e-5)
    with pytest.raises(ValueError, match="'shear' is the largest shear at the sensors"):
        make_run_set(case, RUNS, quantities=("shear",))
