"""Discrete model: modal model on a time grid, its propagators, and rows of monitored outputs.

Propagators are the exact solution of a linear system over a step, with forces polynomial in time.
For z' = A z + B f with f(t) = sum_k f_k l_k(t / h), the l_k being the Lagrange polynomials through
Gauss nodes, the state at any fraction c of a step h is

    z(c h) = Phi_c z(0) + sum_k Theta_ck f_k

with Phi_c = exp(A c h) and Theta_ck a combination of the phi functions
phi_p(X) = int_0^1 e^{(1 - s) X} s^{p - 1} / (p - 1)! ds (Hochbruck and Ostermann, Acta Numerica
2010, section 2). They are Taylor series of X / 2^7, doubled seven times: valid for any damping,
rigid-body modes and lags of actuators, and differentiable.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.model.deflection_lines import LoadInfluence
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.output_rows import (
    CorrectionRows,
    OutputRows,
    StaticCorrection,
    linear_outputs,
)
from jaxbeam.numerics.matrices import MAX_UNROLLED_TERMS
from jaxbeam.numerics.polynomials import (
    gauss_nodes,
    lagrange_coefficients,
    lagrange_weights,
    shift_weights,
)
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    add_at,
    cholesky,
    cond,
    scan,
    set_at,
    solve_triangular,
    stop_gradient,
    vmap,
    xp,
)
from jaxbeam.simulation.integrator.inputs import AbstractInputPolicy
from jaxbeam.simulation.integrator.time_grid import TimeGrid

NODE_COUNT = 6  # Gauss nodes in a step; the integrator has order 12
DOUBLINGS = 7
TAYLOR_TERMS = 14
MANY_MATRICES = 256  # whose products XLA computes faster element by element
MAX_STEP_NORM = 0.5 * 2**DOUBLINGS  # largest norm of A h for which the series is exact to rounding

GAUSS_NODES = gauss_nodes(NODE_COUNT)
# Positions in a step at which the deflection is sampled for its peak: the ends and the Gauss nodes,
# for which propagators exist. Interpolants through these oscillate less than through equal points.
PEAK_NODES = (0.0, *(float(node) for node in GAUSS_NODES), 1.0)


class Propagators(Module):
    """Propagators over steps of given lengths, to the Gauss nodes and to the end of a step.

    `transition_*` act on the state at the start, `input_*` on the inputs at the Gauss nodes, in the
    blocks of the modal model.
    """

    transition_nodes: Float[Array, "*length node block side side"]
    input_nodes: Float[Array, "*length node force block side input"]
    transition_end: Float[Array, "*length block side side"]
    input_end: Float[Array, "*length force block side input"]


def end_weights() -> np.ndarray:
    """Weights (node, end) that extrapolate values at the Gauss nodes to the ends of a step."""
    return lagrange_weights(NODE_COUNT, [0.0, 1.0]).T


def _multiply(a, b):
    """Product of matrices (row, column, ...), spelt out for small blocks, and smaller than many."""
    if a.shape[1] > (3 if math.prod(a.shape[2:]) < MANY_MATRICES else MAX_UNROLLED_TERMS):
        # Matrices last: NumPy then multiplies them by BLAS, twenty times as fast as by `einsum`.
        a, b = (xp.moveaxis(part, (0, 1), (-2, -1)) for part in (a, b))
        return xp.moveaxis(a @ b, (-2, -1), (0, 1))
    return sum(a[:, i, None] * b[None, i] for i in range(a.shape[1]))


def state_matrix_norm(model: ModalModel) -> Float[Array, ""]:
    """Norm of the scaled state matrix in 1/s; `MAX_STEP_NORM` over it bounds the step length."""
    scale = _state_scaling(model)
    matrix = model.state_matrix * scale[:, :, None] / scale[:, None, :]
    return stop_gradient(xp.max(xp.sum(xp.abs(matrix), axis=-1)))


def _state_scaling(model: ModalModel):
    """Scaling (block, side) of the states to equal size of displacements and rates of a mode."""
    blocks, side, _ = model.state_matrix.shape
    modes_per_block = model.modes_per_block
    modes = np.arange(modes_per_block)
    square = xp.abs(model.state_matrix[:, 2 * modes + 1, 2 * modes])
    scale = set_at(xp.ones((blocks, side)), np.s_[:, 2 * modes], xp.sqrt(1.0 + square))
    return stop_gradient(scale)


@jax.named_scope("propagators")
def propagators(
    model: ModalModel, lengths: Float[Array, " *length"], with_commands: bool = False
) -> Propagators:
    """Propagators of a modal model over steps of the given lengths (s), which may be zero.

    Inputs are the generalised forces on the modes, then, `with_commands`, the commands.
    """
    state_scale = _state_scaling(model)
    blocks, side, _ = model.state_matrix.shape
    modes_per_block = model.modes_per_block
    matrix = model.state_matrix * state_scale[:, :, None] / state_scale[:, None, :]
    input_matrix = xp.eye(side)[:, 1 : 2 * modes_per_block : 2]
    if with_commands:
        input_matrix = xp.concatenate([input_matrix, model.command_matrix], axis=1)
    fractions = np.append(GAUSS_NODES, 1.0)
    durations = lengths[..., None] * fractions
    # Blocks are the last axis but that of durations, along which operations vectorise.
    transition, phi_functions = phi_functions_of(
        xp.moveaxis(matrix, 0, -1), input_matrix[..., None], durations
    )
    inputs = xp.einsum("cfp,psmb...c->...cfbsm", force_weights(), phi_functions)
    transition = xp.einsum("stb...c->...cbst", transition)
    # Inputs act on rates and actuators' own states, which the scaling leaves unchanged.
    inputs = inputs / state_scale[:, :, None]
    transition = transition * state_scale[:, None, :] / state_scale[:, :, None]
    return Propagators(
        transition_nodes=transition[..., :NODE_COUNT, :, :, :],
        input_nodes=inputs[..., :NODE_COUNT, :, :, :, :],
        transition_end=transition[..., NODE_COUNT, :, :, :],
        input_end=inputs[..., NODE_COUNT, :, :, :, :],
    )


def phi_functions_of(
    matrix: Float[Array, "side side *system"],
    input_matrix: Float[Array, "side input *#system"],
    durations: Float[Array, "*duration"],
    few_doublings: bool = False,
) -> tuple[Float[Array, "side side *all"], Float[Array, "phi side input *all"]]:
    """exp(A t), and t phi_p(A t) B for p = 1 to 6, of systems over durations t (s).

    With `few_doublings` only as many as the largest norm of A t needs; a `vmap` takes all the same.
    """
    doublings: Any = DOUBLINGS
    if few_doublings:
        norm = xp.max(xp.sum(xp.abs(matrix), axis=1)) * xp.max(durations)
        doublings = xp.ceil(xp.log2(xp.maximum(2 * norm, 1.0))).astype(int)
        doublings = stop_gradient(xp.minimum(doublings, DOUBLINGS))
    x = matrix[..., None] * durations.ravel() / 2**doublings
    functions = _taylor_series(x, input_matrix[..., None])

    def double(functions, i):
        if not few_doublings:
            return _double_argument(functions, i)
        doubled = cond(i < doublings, lambda f: _double_argument(f, i)[0], lambda f: f, functions)
        return doubled, None

    (transition, phi_functions), _ = scan(double, functions, np.arange(DOUBLINGS))
    phi_functions = phi_functions * durations.ravel()
    parts = (transition, phi_functions)
    transition, phi_functions = (part.reshape(*part.shape[:-1], *durations.shape) for part in parts)
    return transition, phi_functions


def force_weights() -> Float[np.ndarray, "fraction force power"]:
    """Weights of the phi functions in the response to forces at the Gauss nodes.

    At the fractions of a step that are its Gauss nodes, then at its end.
    """
    fractions, powers = np.append(GAUSS_NODES, 1.0), np.arange(NODE_COUNT)
    factorials = np.array([math.factorial(p) for p in powers])
    return lagrange_coefficients(NODE_COUNT) * factorials * fractions[:, None, None] ** powers


def _taylor_series(x, input_matrix):
    """exp(x), and phi_1(x) ... phi_6(x) times the input matrix (phi, ...), for small x."""
    side, inputs = input_matrix.shape[:2]
    rest = x.shape[2:]
    # Both series at once: they differ only in the divisors of their terms.
    identity = xp.broadcast_to(xp.eye(side).reshape(side, side, *(1,) * len(rest)), x.shape)
    starting_terms = xp.concatenate(
        [identity, xp.broadcast_to(input_matrix, (side, inputs, *rest))], axis=1
    )
    divisor_offset = np.repeat([0, NODE_COUNT], [side, inputs]).reshape(-1, *(1,) * len(rest))

    def horner(sums, term):
        return starting_terms + _multiply(x, sums) / (term + divisor_offset), None

    sums, _ = scan(horner, starting_terms, np.arange(TAYLOR_TERMS, 0, -1.0))
    transition, highest_phi, input_matrix = sums[:, :side], sums[:, side:], starting_terms[:, side:]
    phi_functions = [highest_phi / math.factorial(NODE_COUNT)]
    for p in range(NODE_COUNT - 1, 0, -1):
        phi_functions.insert(0, input_matrix / math.factorial(p) + _multiply(x, phi_functions[0]))
    return transition, xp.stack(phi_functions)


def _double_argument(functions, _):
    """exp and phi functions of twice the argument."""
    transition, phi_functions = functions
    propagated = vmap(functools.partial(_multiply, transition))(phi_functions)
    others = shift_weights(NODE_COUNT) @ phi_functions.reshape(NODE_COUNT, -1)
    doubled = propagated + others.reshape(phi_functions.shape)
    powers_of_half = 0.5 ** np.arange(1, NODE_COUNT + 1).reshape(
        NODE_COUNT, *(1,) * transition.ndim
    )
    return (_multiply(transition, transition), doubled * powers_of_half), None


def monitored_rows(
    model: ModalModel,
    propagators: Propagators,
    rows: Float[Array, "output state"],
    on_commands: Float[Array, "output command"] | None,
) -> tuple[
    Float[Array, "length sample block side"],
    Float[Array, "length sample force block input"],
]:
    """Rows of outputs on the state at the start of a step and on the forces at its Gauss nodes.

    `rows` act on states at the same instant, `on_commands` on commands. Samples are the outputs at
    each peak node, one node after the other; inputs are the generalised forces, then the commands,
    both polynomials through the Gauss nodes.
    """
    blocks, side, _ = model.state_matrix.shape
    on_side = rows.reshape(-1, blocks, side)
    transition, response = _at_peak_nodes(propagators)
    on_state = xp.einsum("wbi,lpbij->lpwbj", on_side, transition)
    on_forces = xp.einsum("wbi,lpfbik->lpwfbk", on_side, response)
    if on_commands is not None:
        first = model.modes_per_block
        commands = np.s_[..., 0, first : first + on_commands.shape[1]]
        at_nodes = lagrange_weights(NODE_COUNT, PEAK_NODES)[:, None, :, None] * on_commands[:, None]
        on_forces = add_at(on_forces, commands, at_nodes)
    lengths = on_state.shape[0]
    return (
        on_state.reshape(lengths, -1, *on_state.shape[3:]),
        on_forces.reshape(lengths, -1, *on_forces.shape[3:]),
    )


def commands_at_once(
    outputs: OutputRows,
    command_rates: Float[Array, "mode command"],
    corrected: CorrectionRows | None,
) -> Float[Array, "output command"]:
    """Direct response of outputs to commands at the same instant.

    Outputs of accelerations respond to the modal accelerations `command_rates` of unit commands,
    section forces to the active moments of actuators.
    """
    accelerations: Any = outputs.has_feedthrough[:, None] * outputs.rows
    if corrected is not None and corrected.accelerations is not None:
        accelerations = accelerations + corrected.accelerations
    direct, actuators = accelerations @ command_rates, outputs.on_commands.shape[1]
    if actuators:
        direct = add_at(direct, np.s_[:, :actuators], outputs.on_commands)
    if actuators and corrected is not None:
        direct = add_at(direct, np.s_[:, :actuators], corrected.commands)
    return direct


def _at_peak_nodes(propagators: Propagators):
    """Propagators (length, sample, ...) to the peak nodes: start, Gauss nodes and end of a step."""
    identity = xp.broadcast_to(
        xp.eye(propagators.transition_end.shape[-1]), propagators.transition_end.shape
    )
    transitions = (
        identity[:, None],
        propagators.transition_nodes,
        propagators.transition_end[:, None],
    )
    responses = (
        xp.zeros_like(propagators.input_end)[:, None],
        propagators.input_nodes,
        propagators.input_end[:, None],
    )
    return xp.concatenate(transitions, axis=1), xp.concatenate(responses, axis=1)


def bounds_by_energy(
    model: ModalModel, outputs: OutputRows, corrected: CorrectionRows | None = None
) -> Float[Array, "output block"]:
    """Bounds of outputs in free vibration by the energies E = q'^2 + q K q of the blocks.

    An output is at most the sum over the blocks of its bound times sqrt(E). Blocks are uncoupled,
    so that E does not grow. The bound is infinite with rigid-body modes. For a row s on the q of a
    block it is sqrt(s K^-1 s); on q', sqrt(s s); on q'' = -K q - D q', sqrt(s K s) + |D s|; for an
    output with more than one row, their sum.
    """
    blocks, orders = model.state_matrix.shape[0], np.array(outputs.time_derivatives, int)
    bounds = xp.zeros((orders.size, blocks))
    deflections, rates, accelerations = (np.flatnonzero(orders == order) for order in range(3))
    if deflections.size:
        bound = _root_of_static_flexibility(model, outputs.rows[deflections])
        bounds = add_at(bounds, deflections, bound)
    if rates.size:
        bounds = add_at(bounds, rates, _norms_by_block(outputs.rows[rates], blocks))
    if accelerations.size:
        bound = _of_accelerations(model, outputs.rows[accelerations])
        bounds = add_at(bounds, accelerations, bound)
    if corrected is not None and corrected.rates is not None:
        bounds = bounds + _norms_by_block(corrected.rates, blocks)
    if corrected is not None and corrected.accelerations is not None:
        bounds = bounds + _of_accelerations(model, corrected.accelerations)
    return bounds


def energies(model: ModalModel, states: Float[Array, "state batch"]) -> Float[Array, "block batch"]:
    """Energies q'^2 + q K q of the blocks of a model."""
    q, rates = states[model.coordinate_index], states[model.rate_index]
    parts = rates**2 + q * (model.stiffness() @ q)
    return xp.sum(parts.reshape(-1, model.modes_per_block, parts.shape[-1]), axis=1)


def _norms_by_block(rows, blocks: int):
    return xp.sqrt(xp.sum(rows.reshape(rows.shape[0], blocks, -1) ** 2, axis=2))


def _of_accelerations(model: ModalModel, rows) -> Float[Array, "output block"]:
    blocks = model.state_matrix.shape[0]
    damping = -model.A[model.rate_index, model.rate_index]
    elastic = (rows * (rows @ model.stiffness())).reshape(rows.shape[0], blocks, -1)
    return xp.sqrt(xp.sum(elastic, axis=2)) + _norms_by_block(rows @ damping, blocks)


def _root_of_static_flexibility(
    model: ModalModel, shapes: Float[Array, "position mode"]
) -> Float[Array, "position block"]:
    """Root of the static deflection (m/N) of each block at positions under a unit force there.

    Infinite with rigid-body modes. Uncoupled modes are divided by their stiffness, as a
    factorisation would dominate the time.
    """
    if model.modes_per_block == 1:
        return xp.abs(shapes) / xp.sqrt(-model.state_matrix[:, 1, 0])
    half_solved = solve_triangular(cholesky(model.stiffness()), shapes.T, lower=True)
    root = _norms_by_block(half_solved.T, model.state_matrix.shape[0])
    return xp.where(xp.isfinite(root), root, xp.inf)


class DiscreteModel(Module):
    """Modal model on a time grid: propagators of each step length, rows of monitored outputs.

    Outputs are deflections, or other quantities of sensors. `energy_bounds` bound each of them by
    the energies of the blocks (see `bounds_by_energy`). With `with_node_states`, step matrices
    include the states at the nodes. `load_influence` is the direct influence of forces on outputs
    with a static correction. Peaks are those of the absolute value of an output; with `both_ways`
    those of all outputs, then of their negatives. The last outputs are deflections at the
    `absorbers`, given twice, in place of which peaks are those of their strokes (m) and then
    forces (N).
    """

    model: ModalModel
    grid: TimeGrid
    propagators: Propagators
    monitored_transition: Float[Array, "length sample block side"] | None
    monitored_input: Float[Array, "length sample force block input"] | None
    energy_bounds: Float[Array, "position block"] | None
    modal_command_matrix: Float[Array, "mode actuator"] | None
    with_node_states: bool = eqx.field(static=True)
    load_influence: LoadInfluence | None = None
    both_ways: bool = eqx.field(static=True, default=False)
    absorbers: int = eqx.field(static=True, default=0)

    @property
    def position_count(self) -> int:
        """Number of monitored positions."""
        return 0 if self.energy_bounds is None else self.energy_bounds.shape[0]

    @property
    def magnitude(self) -> Callable:
        """Function of a monitored value whose largest value is its peak."""
        return operator.pos if self.both_ways else abs


def discrete_model(
    model: ModalModel,
    grid: TimeGrid,
    positions: Float[Array, " position"] | None,
    policy: AbstractInputPolicy | None = None,
    outputs: OutputRows | None = None,
    correction: StaticCorrection | None = None,
) -> DiscreteModel:
    """Modal model on a time grid, with deflections monitored at `positions` (m), if any.

    An input policy adds the commands, and the states at the nodes if it is implicit. `outputs`, if
    given, are monitored in place of deflections, with their static `correction`, if it is given.
    """
    with_commands = policy is not None
    with_node_states = policy is not None and policy.implicit
    step_propagators = propagators(model, grid.lengths, with_commands)
    modes_per_block = model.modes_per_block
    commands = model.command_matrix[1 : 2 * modes_per_block : 2] if with_commands else None
    if positions is None and outputs is None:
        return DiscreteModel(
            model, grid, step_propagators, None, None, None, commands, with_node_states
        )
    if outputs is None:
        shapes = model.shapes(positions, (0,))[0]
        outputs = OutputRows(shapes, xp.zeros((shapes.shape[0], 0)), (0,) * shapes.shape[0])
    linear = linear_outputs(model, outputs, correction)
    corrected = None if correction is None else correction.rows
    direct = None if commands is None else commands_at_once(outputs, commands, corrected)
    transition, force_response = monitored_rows(model, step_propagators, linear.rows, direct)
    return DiscreteModel(
        model,
        grid,
        step_propagators,
        transition,
        force_response,
        bounds_by_energy(model, outputs, corrected),
        commands,
        with_node_states,
        linear.influence,
    )


def signed_both_ways(discrete: DiscreteModel) -> DiscreteModel:
    """Discrete model that has two peaks of each output: the largest, then that of its negative."""
    bounds = xp.tile(discrete.energy_bounds, (2, 1))
    return dataclasses.replace(discrete, energy_bounds=bounds, both_ways=True)
