"""Predictive control of two spans: derivatives of the cost of a closed loop by its weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.simulation.integration_plan import integration_plan
from tests.differences import central

CASE = jb.Case(
    jb.Beam(1.2, 12.277, 0.7924, 0.03, modes=2),
    [jb.Support(0.6)],
    [
        jb.Patch(x, x + 0.085, 8.292e-4, correction=0.39, amplifier_gain=200.0, limits=[-2.5, 7.5])
        for x in (0.2575, 0.8575)
    ],
    [jb.Sensor(0.3), jb.Sensor(0.9)],
    [jb.MovingMass(mass=0.4, speed=4.0)],
    jb.MPC(3, 2, [1e-9, 2e-9], output_weight=[1.0, 1.0], horizon_weight=[1.0] * 3, period=0.02),
    jb.Run(0.32, sample_rate=50.0),
)
FREE = ("controller.move_weight", "controller.output_weight", "controller.horizon_weight")


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_derivatives_of_a_closed_loop_of_two_spans():
    """Reverse mode, by r_w of each patch and weights of sensors and periods; limits are active.

    The cost is smooth but where a limit becomes active at a sample, where the derivative of the
    program is smoothed (see `numerics.optimisation.qp`). No sample is at such a point, as
    differences of two step sizes agree.
    """
    plan, sizes = integration_plan(CASE, None, 1e-6), [jb.addresses(CASE)[name] for name in FREE]
    ends = np.cumsum([size.size for size in sizes])[:-1]

    def record(logs):
        parts = jnp.split(logs, ends)
        values = {
            name: size * jnp.exp(part) for name, size, part in zip(FREE, sizes, parts, strict=True)
        }
        return jb.simulate(jb.replace(CASE, values), plan=plan)

    @jax.jit
    def cost(logs):
        run = record(logs)
        return 1e6 * jnp.mean(run.deflection**2) + 1e-3 * jnp.mean(run.command**2)

    point = jnp.zeros(7)
    command = np.asarray(record(point).command)
    assert (
        np.max(command) > 7.5 - 1e-9 and 0.05 < np.mean(np.asarray(record(point).saturated)) < 0.7
    )
    expected, coarse = (central(cost, point, step, order=4) for step in (1e-3, 2e-3))
    size = np.max(np.abs(expected))
    assert_allclose(coarse, expected, rtol=0, atol=1e-6 * size)
    assert np.min(np.abs(expected)) > 1e-5 * size
    assert_allclose(jax.jit(jax.grad(cost))(point), expected, rtol=0, atol=1e-6 * size)
