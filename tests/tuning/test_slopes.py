"""Derivatives of what is tuned for, through closed loops of several kinds, against differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
import tuning
from tests.differences import central
from tuning.bench import make_bench

RUNS = tuning.grid({"loads.0.mass": [0.3], "loads.0.speed": [1.5]})
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
    "passage": (
        jb.Passage([-0.2, -0.1], [0.0, 0.4, 1.0], [[1.0, 6.0, 2.0]], period=0.01, lead=0.012),
        {"controller.values.0.1": 6.0, "controller.lead": 0.012},
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


@pytest.mark.slow
@pytest.mark.parametrize("kind", LOOPS)
def test_slopes_through_the_loop_are_those_of_differences(kind):
    controller, start = LOOPS[kind]
    case = rig(controller)
    if kind == "regulator":  # its filter models no filter of the sensor
        case = dataclasses.replace(case, sensors=[jb.Sensor(0.25)])
    bench = make_bench(case, RUNS)
    sizes = np.array(list(start.values()))

    @jax.jit
    def value(shares):
        values = dict(zip(start, shares * sizes, strict=True))
        merits = bench.merits(values, 50.0)
        return merits["peak"][0] + 0.1 * merits["effort"][0]

    ones = np.ones(sizes.size)
    slope = jax.jit(jax.grad(value))(jnp.asarray(ones))
    expected = central(value, ones, step=1e-4)
    np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())
    assert np.all(np.abs(expected) > 1e-7)
