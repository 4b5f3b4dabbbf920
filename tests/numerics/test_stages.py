"""Stages of intervals, against scipy's integration of the plant and of its cost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.interpolate import BarycentricInterpolator

from jaxbeam.numerics.matrices import batch_axis_last
from jaxbeam.numerics.stages import (
    GAUSS_NODES,
    ConstantPlant,
    Coupling,
    collocated_stages,
    coupled_stages,
    riccati_recursion,
    stage_responses,
)

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
    """Coupling of two contact forces, each of which also acts on the acceleration at the other."""
    sizes = zip((1.0, 2.0, 1.0, 0.2), PHASES, strict=True)
    return Coupling(*(size * jnp.sin(2 * t + phase) for size, phase in sizes))


def matrices(t):
    """A and B of the same plant with its contact forces eliminated."""
    part = coupling(t)
    force_rows = jnp.linalg.solve(
        jnp.eye(FORCES) + part.force_feedthrough,
        jnp.concatenate([part.force_state_rows, part.command_feedthrough], axis=1),
    )
    input_directions = PLANT.E @ part.force_distribution
    return PLANT.A + input_directions @ force_rows[
        :, :STATES
    ], PLANT.B + input_directions @ force_rows[:, STATES:]


def nodes(count):
    """Gauss nodes of so many intervals over the time of the test."""
    return START + LENGTH * (np.arange(count)[:, None] + GAUSS_NODES) / count


def by_collocation(count):
    at = jax.vmap(jax.vmap(matrices))(nodes(count))
    return collocated_stages(*at, Q, R, jnp.full(count, LENGTH / count))


def by_coupling(count):
    """With the responses for an interval of this length, halved from a longer one."""
    length, halving = jnp.asarray(LENGTH / count), HALVINGS - 1
    responses = stage_responses(PLANT, Q, length * 2**halving, HALVINGS)
    parts = jax.vmap(jax.vmap(coupling))(nodes(count))
    return coupled_stages(PLANT, jax.tree.map(lambda x: x[halving], responses), parts, R, length)


@pytest.mark.parametrize("stages", [by_collocation, by_coupling])
def test_stage_against_scipy(stages):
    stage = jax.jit(stages, static_argnums=0)(1)
    # A degree for which Gauss's rule is exact for the cost too.
    start, powers = RANDOM.normal(size=STATES), GAUSS_NODES[:, None] ** np.arange(4)
    values = powers @ RANDOM.normal(size=(4, INPUTS))
    command, plant = (
        BarycentricInterpolator(START + LENGTH * GAUSS_NODES, values),
        jax.jit(matrices),
    )

    def rate(t, state):
        (A, B), x, u = plant(t), state[:STATES], command(t)
        return np.append(A @ x + B @ u, x @ Q @ x + u @ R @ u)

    span, options = (START, START + LENGTH), {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    expected = solve_ivp(rate, span, np.append(start, 0.0), **options).y[:, -1]
    start_and_inputs = np.append(start, values)
    assert_allclose(
        stage.transition[0] @ start + stage.input_matrix[0] @ start_and_inputs[STATES:],
        expected[:-1],
        rtol=1e-9,
    )
    assert_allclose(start_and_inputs @ stage.cost[0] @ start_and_inputs, expected[-1], rtol=1e-9)


def test_costs_of_both_kinds_of_stages_are_equal():
    """Also over intervals of length zero."""
    collocated, by_force = (
        jax.jit(lambda stages=stages: cost_to_go(stages(4), Q))()
        for stages in (by_collocation, by_coupling)
    )
    assert_allclose(by_force, collocated, rtol=1e-10)
    zero_length = collocated_stages(*jax.vmap(jax.vmap(matrices))(nodes(1)), Q, R, jnp.zeros(1))
    assert_allclose(cost_to_go(zero_length, 3 * Q)[0], 3 * Q, rtol=1e-14)
