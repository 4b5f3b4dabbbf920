"""Finite-horizon linear-quadratic control of time-varying plants: gains and cost-to-go matrices.

Eqs (3.3) to (3.9) of the thesis, (3.8) with its sign corrected:

    dP/dt = -P A - A'P - Q + P B R^-1 B'P,     P(end) = F,     K = R^-1 B'P

The recursion runs backward over groups of equal intervals; stages are computed a group at a time.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.numerics.batched_linalg import (
    batch_axis_last,
    batch_size_of,
    solve_unpivoted,
    transpose,
    vmap_last_axis,
)
from jaxbeam.numerics.gain_table import GainTable, PlantMatrices, interpolate_gains
from jaxbeam.numerics.matrices import InputWeight, Square
from jaxbeam.numerics.stages import (
    GAUSS_NODES,
    ConstantPlant,
    Coupling,
    collocated_stages,
    command_cost_matrix,
    explicit_force_law,
    riccati_recursion,
    stage_responses,
    stages_of_length,
)
from jaxbeam.runtime.arrays import Array

INTERVALS_PER_GROUP = 8
# Boundary layer: backward in time from an event, P approaches that of the next plant and oscillates
# at twice the modal frequencies. So intervals of the last tenth of the time between two events are
# quartered, those of the tenth before halved, and the last group is halved further, so often:
MAX_HALVINGS = 13
BOUNDARY_LAYER_HALVINGS = [2, 2, 2, *range(3, MAX_HALVINGS + 1), MAX_HALVINGS]

# Time-varying part of a plant at times (s) of any shape.
CouplingFunction = Callable[[Float[Array, "..."]], Coupling]


def interval_halvings(min_intervals: int) -> Int[np.ndarray, " group"]:
    """Number of halvings of each group of intervals, for at least `min_intervals` intervals."""
    group_count = max(1, -(-min_intervals // INTERVALS_PER_GROUP))
    tenth = group_count // 10
    before = np.repeat([0, 1, 2], [group_count - 1 - 2 * tenth, 2 * tenth, 4 * tenth])
    return np.concatenate([before, BOUNDARY_LAYER_HALVINGS])


def breakpoint_fractions(min_intervals: int) -> Float[np.ndarray, " breakpoint"]:
    """Breakpoints of the intervals between two events, as fractions of the time between them."""
    lengths = np.repeat(0.5 ** interval_halvings(min_intervals), INTERVALS_PER_GROUP)
    return np.append(0.0, np.cumsum(lengths) / np.sum(lengths))


def boundary_layer(min_intervals: int) -> Float[np.ndarray, " breakpoint"]:
    """Breakpoints of the boundary layer: time to the event, as fractions of that between events."""
    count = INTERVALS_PER_GROUP * len(BOUNDARY_LAYER_HALVINGS)
    return 1 - breakpoint_fractions(min_intervals)[-1 - count : -1]


def finite_horizon(
    plant: PlantMatrices,
    events: Float[Array, " event"],
    min_intervals: int,
    Q: Square,
    R: InputWeight,
    terminal_cost: Square,
) -> tuple[GainTable, Float[Array, "breakpoint state state"]]:
    """Gains that minimise x'Fx at the last event plus the integral of x'Qx + u'Ru, and P.

    P is that at the breakpoints of the table: between each two events (s) at least `min_intervals`,
    and a boundary layer. F is `terminal_cost`.
    """
    inputs = R.shape[0]
    zero_plant = ConstantPlant(
        jnp.zeros_like(Q), jnp.zeros((Q.shape[0], inputs)), jnp.eye(Q.shape[0])
    )

    def group_stages(_, R, times, length, length_index):
        A, B = jax.vmap(jax.vmap(plant))(times)
        identity = jnp.broadcast_to(zero_plant.E, A.shape)
        force_law = jnp.concatenate([A, B], axis=3)
        return (
            collocated_stages(A, B, Q, R, jnp.full(INTERVALS_PER_GROUP, length)),
            identity,
            force_law,
        )

    return _gains_and_costs(
        lambda: None, group_stages, zero_plant, events, min_intervals, Q, R, terminal_cost
    )


def finite_horizon_coupled(
    plant: ConstantPlant,
    coupling_at: CouplingFunction,
    events: Float[Array, " event"],
    min_intervals: int,
    Q: Square,
    R: InputWeight,
    terminal_cost: Square,
) -> tuple[GainTable, Float[Array, "breakpoint state state"]]:
    """`finite_horizon` for a plant that varies by a few forces (`coupled_stages`): much faster."""

    def responses_of_all_lengths():
        longest = jnp.diff(events) * (
            breakpoint_fractions(min_intervals)[1] * 2.0 ** interval_halvings(min_intervals)[0]
        )
        responses = jax.vmap(lambda length: stage_responses(plant, Q, length, MAX_HALVINGS))(
            longest
        )
        return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), responses)

    def group_stages(responses, R, times, length, length_index):
        coupling = coupling_at(times)
        stages = stages_of_length(plant, responses, length_index, coupling, R, length)
        return stages, coupling.force_distribution, explicit_force_law(coupling)

    return _gains_and_costs(
        responses_of_all_lengths, group_stages, plant, events, min_intervals, Q, R, terminal_cost
    )


def _gains_and_costs(
    stage_responses, group_stages, plant, events, min_intervals, Q, R, terminal_cost
):
    """Gain table, and P at its breakpoints.

    `group_stages` gives stages, force distribution and force law of a group of intervals, from the
    result of `stage_responses`, which is computed once.
    """
    fractions, durations = breakpoint_fractions(min_intervals), jnp.diff(events)
    steps = np.diff(fractions).reshape(-1, INTERVALS_PER_GROUP)
    node_fractions = (
        fractions[:-1].reshape(-1, INTERVALS_PER_GROUP)[:, :, None]
        + steps[:, :, None] * GAUSS_NODES
    )
    times = events[:-1, None, None, None] + durations[:, None, None, None] * node_fractions
    lengths = durations[:, None] * steps[:, 0]
    length_indices = np.arange(durations.size)[:, None] * (MAX_HALVINGS + 1) + interval_halvings(
        min_intervals
    )
    groups = times, lengths, jnp.asarray(length_indices)
    groups = jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), groups)
    R_inverse = solve_unpivoted(R, jnp.eye(R.shape[0]))
    stage_responses = eqx.filter_closure_convert(stage_responses)
    first = jax.tree.map(lambda part: part[0], groups)
    group_stages = eqx.filter_closure_convert(
        group_stages, eqx.filter_eval_shape(stage_responses), R, *first
    )
    costs, coefficients = batch_axis_last(
        _riccati_sweep, stage_responses, group_stages, plant, groups, Q, R, R_inverse, terminal_cost
    )
    costs = jnp.concatenate([costs.reshape(-1, *Q.shape), terminal_cost[None]])
    inner = events[:-1, None] + durations[:, None] * fractions[:-1]
    breakpoints = jnp.append(inner.reshape(-1), events[-1])
    breakpoints = (breakpoints - breakpoints[0]) / (breakpoints[-1] - breakpoints[0])
    coefficients = coefficients.reshape(-1, *coefficients.shape[2:])
    return GainTable(breakpoints, coefficients), costs


def _riccati_sweep(stage_responses, group_stages, plant, groups, Q, R, R_inverse, terminal_cost):
    """P at the starts of intervals, and gain polynomials, of all groups; batch axis last."""
    responses = vmap_last_axis(lambda function: function(), stage_responses)
    zero_R = jnp.zeros((*R.shape[:2], 1))  # so that a batch that differs in R shares its stages

    def backward_step(cost, group):
        length = group[1]
        stages, shape, force_law = vmap_last_axis(
            lambda function, *rest: function(*rest), group_stages, responses, zero_R, *group
        )
        costs = riccati_recursion(stages, vmap_last_axis(command_cost_matrix, R, length), cost)
        coefficients = interpolate_gains(plant, shape, force_law, costs, length, Q, R_inverse)
        return (costs[0] + transpose(costs[0])) / 2, (costs[:-1], coefficients)

    batch_size = batch_size_of(stage_responses, group_stages, plant, groups, Q, R, terminal_cost)
    batched_terminal_cost = jnp.broadcast_to(terminal_cost, (*terminal_cost.shape[:2], batch_size))
    return jax.lax.scan(backward_step, batched_terminal_cost, groups, reverse=True)[1]
