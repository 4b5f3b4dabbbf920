"""Finite-horizon linear-quadratic control of time-varying plants: gains, tables, cost-to-go.

Eqs (3.3) to (3.9) of the thesis, (3.8) with its sign corrected:

    dP/dt = -P A - A'P - Q + P B R^-1 B'P,     P(end) = F,     K = R^-1 B'P

The recursion runs backward over groups of equal intervals; stages are computed a group at a time.

A table of gains over a crossing is a piecewise polynomial: the gain and its first two derivatives
at a breakpoint follow from P and the Riccati equation. There is one for frozen plants, too. The
batch axis is the last.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.numerics.matrices import (
    InputWeight,
    Square,
    batch_axis_last,
    batch_size_of,
    hstack,
    matmul,
    solve_unpivoted,
    transpose,
    vmap_last_axis,
)
from jaxbeam.numerics.polynomials import powers
from jaxbeam.numerics.riccati import lqr
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
from jaxbeam.runtime.arrays import Array, Module, take, xp

INTERVALS_PER_GROUP = 8
# Boundary layer: backward in time from an event, P approaches that of the next plant and oscillates
# at twice the modal frequencies. So intervals of the last tenth of the time between two events are
# quartered, those of the tenth before halved, and the last group is halved further, so often:
MAX_HALVINGS = 13
BOUNDARY_LAYER_HALVINGS = [2, 2, 2, *range(3, MAX_HALVINGS + 1), MAX_HALVINGS]

# Time-varying part of a plant at times (s) of any shape.
CouplingFunction = Callable[[Float[Array, "..."]], Coupling]


PlantMatrices = Callable[[Float[Array, ""]], tuple[Float[Array, "..."], Float[Array, "..."]]]


class GainTable(Module):
    """Gain as a function of the fraction, 0 to 1, of its time span."""

    breakpoints: Float[Array, " breakpoint"]
    coefficients: Float[Array, "interval power input state"]

    def __call__(self, fraction: Float[Array, ""]) -> Float[Array, "input state"]:
        """Gain at a fraction of the time span; held before 0 and after 1.

        At a breakpoint, where gains may jump, it is the gain after it, whatever the rounding.
        """
        i = xp.searchsorted(self.breakpoints, fraction + ROUNDING, side="right") - 1
        i = xp.clip(i, 0, self.coefficients.shape[0] - 1)
        start = take(self.breakpoints, i)
        length = take(self.breakpoints, i + 1) - start
        interval_fraction = (fraction - start) / xp.where(length > 0, length, 1.0)
        fractions = powers(xp.clip(interval_fraction, 0.0, 1.0), self.coefficients.shape[1])
        coefficients = take(self.coefficients, i)
        rows = coefficients.reshape(coefficients.shape[0], -1)
        return (fractions @ rows).reshape(coefficients.shape[1:])


def breakpoints_between(
    events: Float[Array, " event"], fractions: Float[np.ndarray, " fraction"]
) -> Float[Array, " breakpoint"]:
    """Breakpoints (s) at fractions, from 0, of the time from each event to the next."""
    inner = events[:-1, None] + jnp.diff(events)[:, None] * fractions
    return jnp.append(inner.reshape(-1), events[-1])


def uniform_fractions(intervals: int) -> Float[np.ndarray, " fraction"]:
    """Fractions at the starts of equal intervals."""
    return np.arange(intervals) / intervals


def frozen_time_gains(
    plant: PlantMatrices, breakpoints: Float[Array, " breakpoint"], Q: Square, R: InputWeight
) -> GainTable:
    """Infinite-horizon gains of the plant frozen at each time, eqs (3.10) and (3.11) of the thesis.

    Cubics between the breakpoints (s), from the gains and their rates there. Raises as `lqr`.
    """
    lengths = jnp.diff(breakpoints)
    offset = END_OFFSET * lengths

    def gain_and_rate(time, length):
        gain, rate = jax.jvp(lambda t: lqr(*plant(t), Q, R)[0], (time,), (length,))
        return jnp.stack([gain, rate])

    gains_at = jax.vmap(gain_and_rate, out_axes=1)
    coefficients = hermite_polynomials(
        gains_at(breakpoints[:-1] + offset, lengths), gains_at(breakpoints[1:] - offset, lengths)
    )
    return GainTable(
        (breakpoints - breakpoints[0]) / (breakpoints[-1] - breakpoints[0]), coefficients
    )


def hermite_polynomials(
    starts: Float[Array, "order interval *gain"], ends: Float[Array, "order interval *gain"]
) -> Float[Array, "interval power *gain"]:
    """Polynomials through values and their derivatives at both ends of intervals."""
    start_matrix, end_matrix = hermite_matrices(starts.shape[0])
    return jnp.moveaxis(
        jnp.tensordot(start_matrix, starts, 1) + jnp.tensordot(end_matrix, ends, 1), 0, 1
    )


def derivatives_at_breakpoints(
    values: Float[Array, "interval node *value"],
) -> Float[Array, "breakpoint order *value"]:
    """Values and first two derivatives at the start of each interval and at the last end.

    They are those of the polynomials through values at the Gauss nodes.
    """
    starts = jnp.einsum("rj,sj...->sr...", NODES_TO_ENDS[0], values)
    return jnp.concatenate(
        [starts, jnp.einsum("rj,j...->r...", NODES_TO_ENDS[1], values[-1])[None]]
    )


def _power_derivatives(
    position: float, orders: int, powers: int
) -> Float[np.ndarray, "order power"]:
    """Powers of a number, and their derivatives below an order."""
    exponents = np.arange(powers)
    factors = [np.prod([exponents - k for k in range(r)], axis=0) for r in range(orders)]
    remaining_exponents = [np.maximum(exponents - r, 0) for r in range(orders)]
    return np.stack(
        [factor * position**rest for factor, rest in zip(factors, remaining_exponents, strict=True)]
    )


def hermite_matrices(orders: int) -> tuple[Float[np.ndarray, "power order"], ...]:
    """Matrices that map derivatives at 0, and those at 1, to the Hermite polynomial."""
    rows = [_power_derivatives(at, orders, 2 * orders) for at in (0.0, 1.0)]
    inverse = np.linalg.inv(np.concatenate(rows))
    return inverse[:, :orders], inverse[:, orders:]


# (end, order, node): from values at the Gauss nodes to derivatives at both ends.
NODES_TO_ENDS = np.stack(
    [_power_derivatives(at, 3, GAUSS_NODES.size) for at in (0.0, 1.0)]
) @ np.linalg.inv(GAUSS_NODES[:, None] ** np.arange(GAUSS_NODES.size))


def interpolate_gains(
    plant: ConstantPlant,
    force_distribution: Float[Array, "interval node direction force _"],
    force_law: Float[Array, "interval node force state_and_input _"],
    costs: Float[Array, "breakpoint state state batch"],
    length: Float[Array, " _"],
    Q: Float[Array, "state state _"],
    R_inverse: Float[Array, "input input _"],
) -> Float[Array, "interval power input state batch"]:
    """Gain polynomials of degree 5 over intervals of one length (s), from P at their breakpoints.

    The plant is its constant part plus E F (law rows) (x, u), with F and law given at the Gauss
    nodes.
    """
    force_distribution, force_law = (
        derivatives_at_breakpoints(force_distribution),
        derivatives_at_breakpoints(force_law),
    )  # breakpoint, derivative, ...
    force_input = jax.vmap(jax.vmap(lambda part: matmul(plant.E, part)))(force_distribution)

    def at_breakpoint(force_input, force_law, cost):
        return _gain_and_derivatives(plant, force_input, force_law, cost, length, Q, R_inverse)

    gains = jax.vmap(at_breakpoint, out_axes=1)(force_input, force_law, costs)
    return hermite_polynomials(gains[:, :-1], gains[:, 1:])


def _gain_and_derivatives(plant, force_input, force_law, cost, length, Q, R_inverse):
    """Gain and its first two derivatives with respect to the fraction of the interval.

    The plant is A + W V and B + W D with the force input W = E F and the law rows V of the state, D
    of the command. P is never differentiated as a whole, only its products with a few columns.
    """
    states, inputs = plant.B.shape[:2]
    (W, W_1, W_2), (V, V_1, _), (D, D_1, D_2) = (
        force_input,
        force_law[:, :, :states],
        force_law[:, :, states:],
    )
    B, B_1 = plant.B + matmul(W, D), matmul(W_1, D) + matmul(W, D_1)
    B_2 = matmul(W_2, D) + 2 * matmul(W_1, D_1) + matmul(W, D_2)
    VB = matmul(V, B)
    AB, varying = matmul(plant.A, B) + matmul(W, VB), matmul(W_1, VB) + matmul(W, matmul(V_1, B))
    columns = hstack(B_1, AB)
    A_columns = matmul(plant.A, columns) + matmul(W, matmul(V, columns))
    rows = transpose(hstack(B, columns, AB, A_columns, varying, B_2))
    low_rows = rows[: 3 * inputs]
    rows_P = matmul(rows, cost)  # P is symmetric
    B_P, low_rows_P = rows_P[:inputs], rows_P[: 3 * inputs]
    A_rows_P = rows_P[3 * inputs : 6 * inputs]
    gain = matmul(R_inverse, B_P)
    PA = matmul(low_rows_P, plant.A) + matmul(matmul(low_rows_P, W), V)
    PBRBP = matmul(matmul(low_rows, transpose(B_P)), gain)
    cost_rates = length * (PBRBP - A_rows_P - PA - matmul(low_rows, Q))
    B_P_rate, B_1_P_rate, AB_P_rate = (cost_rates[k * inputs : (k + 1) * inputs] for k in range(3))
    gain_rate_rows = B_P_rate + rows_P[inputs : 2 * inputs]  # of B'P
    force_rows = matmul(B_P_rate, W) + matmul(B_P, W_1)
    PA = matmul(B_P_rate, plant.A) + matmul(force_rows, V) + matmul(matmul(B_P, W), V_1)
    mixed = matmul(matmul(low_rows[:inputs], transpose(gain)), gain_rate_rows)
    mixed = mixed + matmul(matmul(low_rows[:inputs], transpose(gain_rate_rows)), gain)
    cost_curvature = length * (mixed - AB_P_rate - rows_P[6 * inputs : 7 * inputs] - PA)
    gain_curvature_rows = rows_P[7 * inputs :] + 2 * B_1_P_rate + cost_curvature
    return jnp.stack(
        [gain, matmul(R_inverse, gain_rate_rows), matmul(R_inverse, gain_curvature_rows)]
    )


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


END_OFFSET = 1e-9  # of an interval: ends are evaluated so far inside, as the plant may jump there
ROUNDING = 1e-12  # of the time span, of fractions at breakpoints

# State matrix A and input matrix B at a time (s).
