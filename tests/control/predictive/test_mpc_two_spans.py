"""Predictive control of two spans in the loop: derivatives of its cost, by weights and horizon."""

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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxbeam.simulate.ContactLossWarning")
def test_derivatives_of_a_closed_loop_of_two_spans():
    """By r_w of each patch, and the weights of sensors and periods, in reverse; limits are felt.

    The cost is a sum of squares and so smooth, but for a limit that begins to be felt at a tick:
    there the program's own derivative is smoothed (see `control.qp`), and no tick is at such a
    point here, which the agreement of differences of two steps proves.
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
