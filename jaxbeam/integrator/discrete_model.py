"""Discrete model: modal model on a time grid, with rows of monitored outputs."""

import dataclasses
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.inputs import AbstractInputPolicy
from jaxbeam.integrator.propagators import NODE_COUNT, PEAK_NODES, Propagators, propagators
from jaxbeam.integrator.time_grid import TimeGrid
from jaxbeam.model.deflection_lines import LoadInfluence
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.output_rows import (
    CorrectionRows,
    OutputRows,
    StaticCorrection,
    linear_outputs,
)
from jaxbeam.numerics.polynomials import lagrange_coefficients
from jaxbeam.runtime.arrays import Array, Module, add_at, cholesky, solve_triangular, xp


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
        at_nodes = force_weights_at_peaks()[:, None, :, None] * on_commands[:, None]
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


def force_weights_at_peaks() -> np.ndarray:
    """Weights (sample, force) that interpolate forces at the Gauss nodes to the peak nodes."""
    powers = np.array(PEAK_NODES)[:, None] ** np.arange(NODE_COUNT)
    return powers @ lagrange_coefficients(NODE_COUNT).T


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
