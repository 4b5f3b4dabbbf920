"""Flows over stretches, against scipy's integration of the plant and of what it costs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.interpolate import BarycentricInterpolator

from jaxbeam.numerics.batched_linalg import batch_axis_last
from jaxbeam.numerics.coupled_stages import ConstantPlant, Coupling, coupled_stages, stage_responses
from jaxbeam.numerics.stages import GAUSS_NODES, collocated_stages, riccati_recursion

STATES, INPUTS, DIRECTIONS, FORCES, HALVINGS = 4, 2, 3, 2, 3
START, LENGTH = 0.4, 0.1
RANDOM = np.random.default_rng(0)
PLANT = ConstantPlant(
    *(jnp.asarray(2 * RANDOM.normal(size=(STATES, n))) for n in (STATES, INPUTS, DIRECTIONS))
)
Q, R = jnp.asarray(np.eye(STATES) + 0.2), jnp.array([[0.3, 0.1], [0.1, 0.5]])
PHASES = [
    RANDOM.uniform(0, 6, size)
    for size in [(DIRECTIONS, FORCES), (FORCES, STATES), (FORCES, INPUTS), (FORCES, FORCES)]
]


def cost_to_go(stages, terminal_cost):
    """P at the start of each interval and at the end."""
    return batch_axis_last(riccati_recursion, stages, jnp.zeros((1, 1)), terminal_cost)


def coupling(t):
    """Two forces, each of which also feels the other."""
    sizes = zip((1.0, 2.0, 1.0, 0.2), PHASES, strict=True)
    return Coupling(*(size * jnp.sin(2 * t + phase) for size, phase in sizes))


def matrices(t):
    """The same plant, its forces eliminated."""
    part = coupling(t)
    law = jnp.linalg.solve(
        jnp.eye(FORCES) + part.force_feedthrough,
        jnp.concatenate([part.force_state_rows, part.command_feedthrough], axis=1),
    )
    push = PLANT.E @ part.force_distribution
    return PLANT.A + push @ law[:, :STATES], PLANT.B + push @ law[:, STATES:]


def nodes(count):
    """Gauss nodes of so many intervals over the time of the test."""
    return START + LENGTH * (np.arange(count)[:, None] + GAUSS_NODES) / count


def by_collocation(count):
    at = jax.vmap(jax.vmap(matrices))(nodes(count))
    return collocated_stages(*at, Q, R, jnp.full(count, LENGTH / count))


def by_coupling(count):
    """With the responses for an interval of this length, halved from a longer one."""
    length, kind = jnp.asarray(LENGTH / count), HALVINGS - 1
    answer = stage_responses(PLANT, Q, length * 2**kind, HALVINGS)
    parts = jax.vmap(jax.vmap(coupling))(nodes(count))
    return coupled_stages(PLANT, jax.tree.map(lambda x: x[kind], answer), parts, R, length)


@pytest.mark.parametrize("made", [by_collocation, by_coupling])
def test_stage_against_scipy(made):
    stage = jax.jit(made, static_argnums=0)(1)
    # Of a degree that Gauss's rule for the cost, too, is exact for.
    start, powers = RANDOM.normal(size=STATES), GAUSS_NODES[:, None] ** np.arange(4)
    values = powers @ RANDOM.normal(size=(4, INPUTS))
    command, plant = (
        BarycentricInterpolator(START + LENGTH * GAUSS_NODES, values),
        jax.jit(matrices),
    )

    def rate(t, state):
        (A, B), x, u = plant(t), state[:STATES], command(t)
        return np.append(A @ x + B @ u, x @ Q @ x + u @ R @ u)

    span, tight = (START, START + LENGTH), {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    expected = solve_ivp(rate, span, np.append(start, 0.0), **tight).y[:, -1]
    both = np.append(start, values)
    assert_allclose(
        stage.transition[0] @ start + stage.input_matrix[0] @ both[STATES:],
        expected[:-1],
        rtol=1e-9,
    )
    assert_allclose(both @ stage.cost[0] @ both, expected[-1], rtol=1e-9)


def test_costs_of_both_kinds_of_stages_are_equal():
    """Also over intervals of length zero."""
    collocated, by_force = (
        jax.jit(lambda made=made: cost_to_go(made(4), Q))()
        for made in (by_collocation, by_coupling)
    )
    assert_allclose(by_force, collocated, rtol=1e-10)
    still = collocated_stages(*jax.vmap(jax.vmap(matrices))(nodes(1)), Q, R, jnp.zeros(1))
    assert_allclose(cost_to_go(still, 3 * Q)[0], 3 * Q, rtol=1e-14)
