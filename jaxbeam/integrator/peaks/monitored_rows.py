"""Rows of monitored outputs at the peak nodes of a step, on its initial state and its forces."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.propagators import NODE_COUNT, PEAK_NODES, Propagators
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.corrected_rows import CorrectionRows
from jaxbeam.model.sensing.output_rows import OutputRows
from jaxbeam.numerics.gauss import lagrange_coefficients
from jaxbeam.runtime.arrays import Array, add_at, cholesky, solve_triangular, xp


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

    `rows` are those on states at the same instant, `on_commands` on commands. Samples are the
    outputs at each peak node, one node after the other; inputs are the generalised forces, then the
    commands, both polynomials through the Gauss nodes.
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
    """What commands change of outputs at the same instant.

    `command_rates` are the accelerations of the modes, which accelerations follow; the active
    moments of actuators are part of section forces.
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
    """Propagators (length, sample, ...) to the start, the Gauss nodes and the end of a step."""
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
    """Weights (sample, force) from forces at the Gauss nodes to those at the peak nodes."""
    powers = np.array(PEAK_NODES)[:, None] ** np.arange(NODE_COUNT)
    return powers @ lagrange_coefficients(NODE_COUNT).T


def bounds_by_energy(
    model: ModalModel, outputs: OutputRows, corrected: CorrectionRows | None = None
) -> Float[Array, "output block"]:
    """Bounds of free outputs by the energies E = q'^2 + q K q of the blocks of a model.

    An output is at most the sum over the blocks of its bound times sqrt(E). Blocks do not couple,
    so that no E grows. Infinite with rigid-body modes. For a row s on the q of a block it is
    sqrt(s K^-1 s); on q', sqrt(s s); on q'' = -K q - D q', sqrt(s K s) + |D s|; of an output with
    more than one row, the sum.
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

    Infinite with rigid-body modes. Uncoupled modes need no factorisation, which would dominate the
    time.
    """
    if model.modes_per_block == 1:
        return xp.abs(shapes) / xp.sqrt(-model.state_matrix[:, 1, 0])
    half_solved = solve_triangular(cholesky(model.stiffness()), shapes.T, lower=True)
    root = _norms_by_block(half_solved.T, model.state_matrix.shape[0])
    return xp.where(xp.isfinite(root), root, xp.inf)
