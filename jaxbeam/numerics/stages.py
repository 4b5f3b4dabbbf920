"""Discrete-time equivalents of plants over an interval, with quadratic costs.

Equivalents of x' = A x + B u are exact for inputs polynomial between samples. The commands are the
polynomials through their values U at the Gauss nodes of the interval:

    x1 = Phi x0 + Gamma U,     integral of x'Qx + u'Ru = (x0, U)' W (x0, U)

Optimal control minimises over U, one interval after the other, backward in time: for a cost P at
the end, that at the start is the minimum of W + (Phi, Gamma)' P (Phi, Gamma) over U.

Stages of a plant that varies in time only by a few forces: a beam under travelling masses.

    x' = A x + B u + E F(t) f,      f = V(t) x + S(t) u - D(t) f

A, B and E, the directions of the forces, are constant; f are a few numbers, such as contact forces.
Over an interval F f and u are the polynomials through their values at the Gauss nodes. The exact
response and cost of the constant part to them (`stage_responses`) depend on the length of the
interval only; the law of f at the nodes then is one small linear system an interval. So the length
of an interval is limited by how fast f and the optimal u vary, not by the constant part. Where a
plant has much faster lags, u is no such polynomial, and `stages` is accurate with longer intervals.
"""

import functools
import math
import operator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.numerics.matrices import (
    InputMatrix,
    InputWeight,
    Square,
    batch_size_of,
    expm,
    matmul,
    solve_batch,
    solve_each,
    solve_unpivoted,
    symmetric_part,
    transpose,
)
from jaxbeam.numerics.polynomials import (
    gauss_nodes,
    gauss_weights,
    integration_matrix,
    lagrange_coefficients,
    powers,
    shift_weights,
)
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    add_at,
    any_jax,
    fori_loop,
    index_in_dim,
    is_jax,
    scan,
    set_at,
    stop_gradient,
    take,
    xp,
)

DOUBLINGS = 14  # of the short interval of the series
SERIES_ROUNDING = 1e-16  # of a term of a series of exp(M), below which it is the last
MAX_SERIES_TERMS = 20  # while the norm of M is below 1
SERIES_TERMS = 10  # exact to rounding while the norm of the matrix over that interval is below 0.05


def c2d(
    A: Float[Array, "state state"],
    B: Float[Array, "state input"],
    period: Float[Array, ""] | float,
    degree: int = 0,
) -> tuple[Float[Array, "state state"], Float[Array, "power state input"]]:
    """Transition Phi and input matrices Gamma over a period h: x(h) = Phi x(0) + sum_k Gamma_k c_k.

    The input is u(s) = sum_k c_k (s / h)^k with k up to `degree`: 0 is a zero-order hold, 1 a
    first-order hold with c_0 = u(0) and c_1 = u(h) - u(0). Exact, by one matrix exponential
    (Van Loan, IEEE Trans. Automatic Control 1978) of the balanced system.
    """
    scale = balance(A)
    A, B = A * scale / scale[:, None], B / scale[:, None]
    states, inputs = B.shape
    powers = degree + 1
    # The derivatives of the input by s / h are further states, each the rate of the previous one.
    block = xp.zeros((states + inputs * powers,) * 2)
    block = set_at(block, np.s_[:states, :states], A * period)
    block = set_at(block, np.s_[:states, states : states + inputs], B * period)
    block = set_at(block, np.s_[states:, states:], np.kron(np.eye(powers, k=1), np.eye(inputs)))
    exponential = expm(block)
    input_matrix = exponential[:states, states:].reshape(states, powers, inputs)
    factorials = np.array([math.factorial(k) for k in range(powers)], float)
    transition = exponential[:states, :states] * scale[:, None] / scale
    return transition, xp.moveaxis(input_matrix, 1, 0) * factorials[:, None, None] * scale[:, None]


def exponential_and_gramian(
    matrix: Float[Array, "*batch state state"], intensity: Float[Array, "*batch state state"]
) -> tuple[Float[Array, "*batch state state"], Float[Array, "*batch state state"]]:
    """exp(M) and the integral of exp(M s) N exp(M's) over s from 0 to 1; N is the intensity.

    By the series of a small fraction of M and doubling: unlike the blocks of one larger exponential
    (Van Loan 1978), this is accurate however fast the plant decays.
    """
    scaled_matrix, scaled_intensity = matrix / 2**DOUBLINGS, intensity / 2**DOUBLINGS
    identity = xp.broadcast_to(xp.eye(matrix.shape[-1]), matrix.shape)

    def horner(sums, k):
        exponential, integral = sums
        product = scaled_matrix @ integral
        return (
            identity + scaled_matrix @ exponential / k,
            scaled_intensity + (product + product.mT) / (k + 1),
        ), None

    def double(sums, _):
        exponential, integral = sums
        return (exponential @ exponential, integral + exponential @ integral @ exponential.mT), None

    sums, _ = scan(horner, (identity, scaled_intensity), np.arange(SERIES_TERMS, 0.0, -1.0))
    return scan(double, sums, length=DOUBLINGS)[0]


def balance(matrix: Float[Array, "state state"]) -> Float[Array, " state"]:
    """Scale of the states with which rows and columns of the matrix have similar norms.

    Without it, squaring an exponential of deflections in m and their rates in m/s loses digits.
    The balanced matrix is A * scale / scale[:, None]. The scale has no derivative: use it where
    results depend on it by rounding only, else `differentiable_balance`.
    """
    return stop_gradient(differentiable_balance(matrix))


def differentiable_balance(matrix: Float[Array, "state state"]) -> Float[Array, " state"]:
    """Scale of the states as `balance` returns it, with its derivative."""
    size = xp.abs(matrix) * (1 - np.eye(matrix.shape[0]))

    def equalise(_, scale):
        scaled = size * scale / scale[:, None]
        rows, columns = xp.sum(scaled, axis=1), xp.sum(scaled, axis=0)
        both = (rows > 0) & (columns > 0)
        ratio = xp.where(both, rows, 1.0) / xp.where(both, columns, 1.0)
        return scale * ratio**0.25  # half the step for one state, as all change at once

    start = xp.ones_like(xp.diagonal(matrix))
    return fori_loop(0, 20, equalise, start)


def propagate(matrix, t, duration, substeps: int, start):
    """State x(t + duration) of x' = matrix(time) x from x(t) = start, a vector or matrix.

    Each substep is two exponentials of matrices at Gauss nodes (order 4; Blanes and Moan, Applied
    Numerical Mathematics 56, 2006), exact for a constant matrix. For several concrete times t at
    once, `matrix` and `start` have them as their first axis.
    """
    step = duration / substeps
    first_node, second_node = 0.5 - math.sqrt(3) / 6, 0.5 + math.sqrt(3) / 6
    larger_weight, smaller_weight = (
        (0.25 + math.sqrt(3) / 6) * step,
        (0.25 - math.sqrt(3) / 6) * step,
    )

    def step_state(state, time):
        first, second = matrix(time + first_node * step), matrix(time + second_node * step)
        for part in (
            larger_weight * first + smaller_weight * second,
            smaller_weight * first + larger_weight * second,
        ):
            state = exponential_times(part, state)
        return state, None

    starts = np.arange(substeps).reshape(-1, *(1,) * xp.ndim(t))
    return scan(step_state, start, t + step * starts)[0]


def exponential_times(matrix, state):
    """Product exp(M) X; for a stack of concrete matrices by the series of the product."""
    if is_jax(matrix) or matrix.ndim == 2:
        return expm(matrix) @ state
    scale = balance(np.max(np.abs(matrix), axis=0))
    matrix, state = matrix * scale / scale[:, None], state / scale[:, None]
    # Inputs, whose rates are zero, add nothing to powers of the matrix.
    varies = np.any(matrix, axis=(0, 2))
    norm = np.max(np.sum(np.abs(matrix[:, :, varies]), axis=1), initial=0.0)
    parts = max(1, math.ceil(norm))
    bounds = np.cumprod(norm / parts / np.arange(1, MAX_SERIES_TERMS))
    terms = 2 + int(np.sum(bounds > SERIES_ROUNDING))
    matrix = matrix / parts
    for _ in range(parts):
        series = state
        for power in range(terms, 0, -1):
            series = matrix @ series
            series /= power
            series += state
        state = series
    return state * scale[:, None]


def hermite_cubics(
    times: Float[Array, " time"],
    values: Float[Array, " time"],
    rates: Float[Array, " time"] | None = None,
) -> Float[Array, "interval power"]:
    """Coefficients c_k of the cubics in s / h through samples and their rates (per s).

    Without rates they are straight lines.
    """
    difference = xp.diff(values)
    start, end = (difference, difference)
    if rates is not None:
        duration = xp.diff(times)
        start, end = rates[:-1] * duration, rates[1:] * duration
    return xp.stack(
        [values[:-1], start, 3 * difference - 2 * start - end, start + end - 2 * difference], -1
    )


def evaluate_cubics(
    times: Float[Array, " time"],
    coefficients: Float[Array, "interval power"],
    query_times: Float[Array, " *query"],
) -> Float[Array, " *query"]:
    """Values of piecewise cubics at any times (s); held before the first and after the last."""
    interval = xp.clip(
        xp.searchsorted(times, query_times, side="right") - 1, 0, coefficients.shape[0] - 1
    )
    start = take(times, interval)
    fraction = (query_times - start) / (take(times, interval + 1) - start)
    own = xp.moveaxis(take(coefficients, interval), -1, 0)
    return xp.sum(own * powers(xp.clip(fraction, 0.0, 1.0), own.shape[0]), axis=0)


NODE_COUNT = 6  # Gauss nodes of an interval; order 12
GAUSS_NODES = gauss_nodes(NODE_COUNT)


class Stage(Module):
    """Transition Phi, input matrix Gamma and cost matrix W of an interval; see the module."""

    transition: Float[Array, "*batch state state"]
    input_matrix: Float[Array, "*batch state node_input"]
    cost: Float[Array, "*batch state_and_input state_and_input"]


def collocated_stages(
    A: Float[Array, "interval node state state"],
    B: Float[Array, "interval node state input"],
    Q: Square,
    R: InputWeight,
    lengths: Float[Array, " interval"],
) -> Stage:
    """Stages of intervals of given lengths (s), for a plant given at their `GAUSS_NODES`.

    Collocation of x' = A x + B u, with the cost by Gauss's rule, equals collocation of the
    equations of optimal state and costate, of order 12 (Hager, Numer. Math. 87, 2000). The phase of
    the fastest mode should advance by at most about 2 rad in an interval.
    """
    scale = balance(A[0, 0])
    scaled_A, scaled_B = A * scale / scale[:, None], B / scale[:, None]

    def collocate(part):
        matrix, column, length = part
        return _collocated_stage(matrix, column, length, Q * scale * scale[:, None], R)

    scaled_stages = jax.lax.map(collocate, (scaled_A, scaled_B, lengths), batch_size=16)
    scale_with_inputs = jnp.concatenate([scale, jnp.ones(scaled_stages.input_matrix.shape[-1])])
    return Stage(
        transition=scaled_stages.transition * scale[:, None] / scale,
        input_matrix=scaled_stages.input_matrix * scale[:, None],
        cost=scaled_stages.cost / scale_with_inputs / scale_with_inputs[:, None],
    )


def riccati_recursion(
    stages: Stage,
    command_cost: Float[Array, "#node_input #node_input #batch"],
    terminal_cost: Float[Array, "state state #batch"],
) -> Float[Array, "breakpoint state state batch"]:
    """P at the start of each of successive intervals and at the end, batch axis last.

    `command_cost` is added to the cost of the commands; so a batch that differs in R alone shares
    its stages.
    """
    states = terminal_cost.shape[0]

    def backward_step(cost, part):
        dynamics, stage_cost = part  # (Phi, Gamma)'
        quadratic_cost = stage_cost + matmul(dynamics, transpose(matmul(dynamics, cost)))
        cross_cost = quadratic_cost[states:, :states]
        gain = solve_batch(quadratic_cost[states:, states:] + command_cost, cross_cost)
        cost = quadratic_cost[:states, :states] - matmul(transpose(cross_cost), gain)
        return cost, cost

    transition_and_input = jnp.concatenate(
        [stages.transition, stages.input_matrix], axis=2
    ).swapaxes(1, 2)
    batched_terminal_cost = jnp.broadcast_to(
        terminal_cost, (states, states, batch_size_of(stages, command_cost, terminal_cost))
    )
    costs = jax.lax.scan(
        backward_step, batched_terminal_cost, (transition_and_input, stages.cost), reverse=True
    )[1]
    return jnp.concatenate([costs, batched_terminal_cost[None]])


def _collocated_stage(A, B, length, Q, R) -> Stage:
    """Stage of a plant with matrices (node, state, ...).

    Unknown are the rates h x'_i at the nodes, with x_i = x0 + sum_j a_ij h x'_j.
    """
    _, size, inputs = B.shape
    A, B, values = length * A, length * B, NODE_COUNT * inputs
    integration_weights = integration_matrix(NODE_COUNT)
    quadrature_weights = gauss_weights(NODE_COUNT)
    rows = NODE_COUNT * size
    state_coupling = integration_weights[:, None, :, None] * A[:, :, None, :]
    input_coupling = np.eye(NODE_COUNT)[:, None, :, None] * B[:, :, None, :]
    right = jnp.concatenate([A, input_coupling.reshape(NODE_COUNT, size, values)], axis=2)
    rates = xp.linalg.solve(
        jnp.eye(rows) - state_coupling.reshape(rows, rows), right.reshape(rows, size + values)
    ).reshape(NODE_COUNT, size, size + values)
    start = np.eye(size, size + values)
    states = start + jnp.tensordot(integration_weights, rates, axes=1)
    end = start + jnp.tensordot(quadrature_weights, rates, axes=1)
    weighted = quadrature_weights[:, None, None] * (Q @ states)
    integrated_cost = symmetric_part(jnp.tensordot(states.mT, weighted, ((0, 2), (0, 1))))
    cost = length * integrated_cost + jnp.pad(command_cost_matrix(R, length), (size, 0))
    return Stage(end[:, :size], end[:, size:], cost)


def command_cost_matrix(
    R: InputWeight, length: Float[Array, ""]
) -> Float[Array, "node_input node_input"]:
    """Cost matrix of the commands over an interval (s); Gauss's rule is exact for their squares."""
    # Over an interval of length zero the commands have no effect; a cost keeps W invertible.
    safe_length = jnp.where(length > 0, length, 1.0)
    return safe_length * jnp.kron(np.diag(gauss_weights(NODE_COUNT)), R)


TAYLOR_TERMS = 12  # of the series for the shortest intervals


class ConstantPlant(Module):
    """Constant part A, B, E of a plant; see the module."""

    A: Square
    B: InputMatrix
    E: Float[Array, "state direction"]


class Coupling(Module):
    """Time-varying part F, V, S, D of a plant; see the module."""

    force_distribution: Float[Array, "*time direction force"]
    force_state_rows: Float[Array, "*time force state"]
    command_feedthrough: Float[Array, "*time force input"]
    force_feedthrough: Float[Array, "*time force force"]


class StageResponse(Module):
    """Response and cost of the constant part over an interval.

    `state_at_nodes` and `state_at_end` give the state at the Gauss nodes and at the end from
    (x0, commands, E F f), and `cost` is the integral of x'Qx as a quadratic form of these.
    Commands and forces are values at the nodes, ordered by node.
    """

    state_at_nodes: Float[Array, "*length node source state"]
    state_at_end: Float[Array, "*length state source"]
    cost: Float[Array, "*length source source"]


def stage_responses(
    plant: ConstantPlant, Q: Square, length: Float[Array, ""], halvings: int
) -> StageResponse:
    """Responses for intervals of a length (s), of half of it, and so on, the longest first.

    By Taylor series for the shortest interval, and doubling. Inputs are first the polynomials
    sum_p c_p s^p / p! of the fraction s of the interval, then those through values at the nodes.
    """
    inputs = xp.concatenate([plant.B, plant.E], axis=1)
    states, count = inputs.shape
    fractions = np.append(GAUSS_NODES, 1.0)
    shortest_length = length / 2**halvings
    transition, input_responses = _phi_functions(plant.A * shortest_length, inputs, fractions)
    # States at the nodes of the shortest interval.
    powers = fractions[:, None] ** np.arange(1, NODE_COUNT + 1)
    state_at_nodes = (
        shortest_length * powers[:NODE_COUNT, :, None, None] * input_responses[:NODE_COUNT]
    )
    state_at_nodes = xp.concatenate(
        [transition[:NODE_COUNT], _flatten_node_columns(state_at_nodes)], axis=2
    )
    quadrature = gauss_weights(NODE_COUNT)[:, None, None]
    cost = xp.tensordot(state_at_nodes.mT, quadrature * (Q @ state_at_nodes), ((0, 2), (0, 1)))

    def double(carry, _):
        transition, input_responses, cost, length = carry
        doubled = _double_phi(transition, input_responses)
        doubled_cost = _double_cost(transition[-1], length * input_responses[-1], cost, count)
        return (*doubled, doubled_cost, 2 * length), carry

    start = (transition, input_responses, shortest_length * cost, shortest_length)
    longest, shorter = scan(double, start, length=halvings)
    transition, input_responses, cost, lengths = jax.tree.map(
        lambda some, last: xp.concatenate([some, last[None]])[::-1], shorter, longest
    )
    # From coefficients to values at the nodes, commands first.
    factorials = np.array([math.factorial(p) for p in range(NODE_COUNT)])
    lagrange = lagrange_coefficients(NODE_COUNT) * factorials  # node, power
    local = lagrange * powers[:, None]  # fraction, node, power: over each fraction of the interval
    node_input_response = (
        xp.einsum("cqp,lcpik->lciqk", local, input_responses) * lengths[:, None, None, None, None]
    )
    state_response = xp.concatenate(
        [transition, _commands_before_forces(node_input_response, plant)], axis=3
    )
    cross_cost = cost[:, :states, states:].reshape(-1, states, NODE_COUNT, count)
    cross_cost = _commands_before_forces(xp.einsum("qp,lipk->liqk", lagrange, cross_cost), plant)
    input_cost = cost[:, states:, states:].reshape(-1, NODE_COUNT, count, NODE_COUNT, count)
    input_cost = xp.einsum("qp,lpkxj->lqkxj", lagrange, input_cost)
    input_cost = _commands_before_forces(xp.einsum("qx,lpkxj->lpkqj", lagrange, input_cost), plant)
    input_cost = _commands_before_forces(xp.moveaxis(input_cost, (1, 2), (-2, -1)), plant)
    top = xp.concatenate([cost[:, :states, :states], cross_cost], axis=2)
    below = xp.concatenate([cross_cost.mT, input_cost], axis=2)
    return StageResponse(
        state_response[:, :NODE_COUNT].mT,
        state_response[:, -1],
        xp.concatenate([top, below], axis=1),
    )


def node_forces(
    plant: ConstantPlant, response: StageResponse, coupling: Coupling, explicit: bool = False
) -> tuple[Float[Array, "interval node_force column"], Float[Array, "node direction force _"]]:
    """Forces f at the nodes per unit of (x0, commands at the nodes), and F, intervals last.

    For intervals of one length from the coupling (interval, node) at their nodes. Where no force
    depends on another one, nor on the states that forces change, the law is `explicit`.
    """
    states, inputs = plant.B.shape
    free_columns = states + NODE_COUNT * inputs  # the states at the start and the commands
    interval_count, forces = coupling.force_state_rows.shape[0], coupling.force_state_rows.shape[2]
    size = NODE_COUNT * forces
    # Rows of V x + S u at the nodes, and of f itself. Intervals are the last axis: sums are short.
    distribution = xp.moveaxis(coupling.force_distribution, 0, -1)
    contact_rows = xp.einsum("cwi,scri->cwrs", response.state_at_nodes, coupling.force_state_rows)
    # (node, input, force, interval)
    direct = xp.moveaxis(coupling.command_feedthrough, 0, -1).swapaxes(1, 2)
    direct_part = np.eye(NODE_COUNT)[:, :, None, None, None] * direct[:, None]
    direct_part = direct_part.reshape(NODE_COUNT, -1, forces, interval_count)
    right = add_at(contact_rows[:, :free_columns], np.s_[:, states:], direct_part)
    right = right.swapaxes(1, 2).reshape(size, free_columns, interval_count)
    if explicit:
        return xp.moveaxis(right, -1, 0), distribution
    force_on_force = contact_rows[:, free_columns:].reshape(
        NODE_COUNT, NODE_COUNT, -1, forces, interval_count
    )
    force_on_force = _unrolled_sum(
        force_on_force[:, :, :, :, None] * distribution[:, :, None], 2
    ).swapaxes(1, 2)
    force_feedthrough = np.eye(forces)[:, :, None] + xp.moveaxis(coupling.force_feedthrough, 0, -1)
    force_system = (
        np.eye(NODE_COUNT)[:, None, :, None, None] * force_feedthrough[:, :, None] - force_on_force
    )
    system = force_system.reshape(size, size, interval_count)
    return solve_each(system, right), distribution


def coupled_stages(
    plant: ConstantPlant,
    response: StageResponse,
    coupling: Coupling,
    R: InputWeight,
    length: Float[Array, ""],
) -> Stage:
    """Stages of intervals of one length (s), from the coupling (interval, node) at their nodes."""
    states, inputs = plant.B.shape
    free_columns = states + NODE_COUNT * inputs
    force, distribution = node_forces(plant, response, coupling)
    interval_count, size, _ = force.shape
    # Response of the end to the forces; their cost with x0 and u, and by themselves.
    force_response = xp.concatenate([response.state_at_end, response.cost])[:, free_columns:]
    force_response = force_response.reshape(-1, NODE_COUNT, distribution.shape[1])
    force_response = xp.einsum("wqd,qdts->wqts", force_response, distribution).reshape(
        -1, size, interval_count
    )
    directed = force_response[states + free_columns :].reshape(NODE_COUNT, -1, size, interval_count)
    force_cost = _unrolled_sum(directed[:, :, None] * distribution[:, :, :, None], 1).reshape(
        size, size, interval_count
    )
    force_to_end, cross_cost, force_cost = (
        xp.moveaxis(part, -1, 0)
        for part in (
            force_response[:states],
            force_response[states : states + free_columns],
            force_cost,
        )
    )
    end = response.state_at_end[:, :free_columns] + force_to_end @ force
    command_cost = xp.pad(command_cost_matrix(R, length), (states, 0))
    force_part = force.mT @ (cross_cost.mT + force_cost @ force / 2)
    cost = response.cost[:free_columns, :free_columns] + command_cost + force_part + force_part.mT
    return Stage(end[..., :states], end[..., states:], cost)


def stages_of_length(
    plant: ConstantPlant,
    responses: StageResponse,
    length_index: Int[Array, ""],
    coupling: Coupling,
    R: InputWeight,
    length: Float[Array, ""],
) -> Stage:
    """`coupled_stages` for intervals of one of the lengths of `responses`."""
    response = jax.tree.map(lambda part: index_in_dim(part, length_index, 0, False), responses)
    return coupled_stages(plant, response, coupling, R, length)


def explicit_force_law(coupling: Coupling) -> Float[Array, "interval node force state_and_input"]:
    """Rows of the explicit law f = (1 + D)^-1 (V x + S u)."""
    law = xp.eye(coupling.force_feedthrough.shape[-1]) + coupling.force_feedthrough
    right_side = xp.concatenate([coupling.force_state_rows, coupling.command_feedthrough], axis=3)
    return jax.vmap(jax.vmap(solve_unpivoted))(law, right_side)


def _unrolled_sum(terms, axis):
    """Sum over a short axis; where traced unrolled, which is shorter to run than a loop."""
    if not any_jax(terms):
        return np.sum(terms, axis=axis)
    return functools.reduce(operator.add, jnp.unstack(terms, axis=axis))


def _flatten_node_columns(input_responses):
    """Responses (fraction, power, state, input) as columns (fraction, state, power and input)."""
    ordered = xp.moveaxis(input_responses, 1, 2)
    return ordered.reshape(*ordered.shape[:2], -1)


def _commands_before_forces(columns, plant: ConstantPlant):
    """Columns (..., node, input) as (..., column), commands of all nodes before the forces."""
    inputs = plant.B.shape[1]
    commands, forces = columns[..., :inputs], columns[..., inputs:]
    shape = (*columns.shape[:-2], -1)
    return xp.concatenate([commands.reshape(shape), forces.reshape(shape)], axis=-1)


def _phi_functions(x, inputs, fractions):
    """exp(c x), and phi_1, ... of c x times the inputs, for fractions c of a small matrix x."""
    states = x.shape[0]
    columns = xp.concatenate([xp.eye(states), inputs], axis=1)
    rows = [columns]
    for _ in range(TAYLOR_TERMS - 1):
        rows.append(x @ rows[-1])
    powers, terms = xp.stack(rows), np.arange(TAYLOR_TERMS)
    fraction_powers = fractions[:, None] ** terms
    orders = np.arange(NODE_COUNT + 1)[:, None] + terms
    weights = fraction_powers[:, None] / np.vectorize(math.factorial)(orders).astype(float)
    transition = xp.tensordot(weights[:, 0], powers[:, :, :states], axes=1)
    return transition, xp.tensordot(weights[:, 1:], powers[:, :, states:], axes=1)


def _double_phi(transition, input_responses):
    """Exponentials and phi functions (fraction, phi, state, input) of the doubled argument."""
    halves = 0.5 ** np.arange(1, NODE_COUNT + 1)
    doubled = transition[:, None] @ input_responses + xp.einsum(
        "pq,cqik->cpik", shift_weights(NODE_COUNT), input_responses
    )
    return transition @ transition, doubled * halves[:, None, None]


def _double_cost(transition, input_responses, cost, count):
    """Cost of two equal intervals together, for inputs with coefficients over both."""
    states = transition.shape[0]
    first = 0.5 ** np.arange(NODE_COUNT)
    # Columns (state, power and input).
    first_half_inputs = xp.moveaxis(input_responses * first[:, None, None], 0, 1)
    first_half_inputs = first_half_inputs.reshape(states, -1)
    scale = np.append(np.ones(states), np.repeat(first, count))
    # (coefficient over the second, coefficient over both)
    second_half_weights = shift_weights(NODE_COUNT).T * first

    def to_second_half(columns):
        """Columns for coefficients over the second interval, as columns for those over both."""
        split = columns.reshape(-1, NODE_COUNT, count)
        return xp.einsum("ipk,pq->iqk", split, second_half_weights).reshape(columns.shape)

    cross_cost, input_cost = cost[:states, states:], cost[states:, states:]
    cross_second_half = to_second_half(cross_cost)
    cost_of_end_state = cost[:states, :states] @ xp.concatenate(
        [transition, first_half_inputs], axis=1
    )
    state_cost = transition.T @ cost_of_end_state[:, :states]
    new_cross_cost = transition.T @ (cost_of_end_state[:, states:] + cross_second_half)
    end_state_cost = first_half_inputs.T @ (cost_of_end_state[:, states:] / 2 + cross_second_half)
    new_input_cost = (
        to_second_half(to_second_half(input_cost).T) + end_state_cost + end_state_cost.T
    )
    top = xp.concatenate([state_cost, new_cross_cost], axis=1)
    return cost * scale * scale[:, None] + xp.concatenate(
        [top, xp.concatenate([new_cross_cost.T, new_input_cost], axis=1)]
    )
