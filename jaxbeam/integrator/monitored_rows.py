"""Rows of monitored outputs at the peak nodes of a step, on its initial state and its forces."""

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
    outputs: OutputRows,
    command_rates: Float[Array, "mode actuator"] | None,
    corrected: CorrectionRows | None = None,
) -> tuple[
    Float[Array, "length sample block side"],
    Float[Array, "length sample force block input"],
]:
    """Rows of outputs on the state at the start of a step and on the forces at its Gauss nodes.

    Samples are the outputs at each peak node, one node after the other; inputs are the generalised
    forces, then the commands, whose `command_rates` are accelerations of the modes. Accelerations
    are q'' = (rows of A) z + forces, with the forces as polynomials through the Gauss nodes.
    `corrected` are rows of the static correction, in addition.
    """
    blocks, count = model.state_matrix.shape[0], model.modes_per_block
    rows = outputs.rows.reshape(-1, blocks, count)
    transition, response = _at_peak_nodes(propagators)
    accelerations = model.state_matrix[:, 1 : 2 * count : 2]
    orders = np.array(outputs.time_derivatives, int)
    on_state, on_forces, grouped = [], [], []
    for order in np.unique(orders) if orders.size else (0,):
        index = np.flatnonzero(orders == order)
        on_side, sides = rows[index], np.s_[order : 2 * count : 2]
        if order == 2:
            on_side, sides = xp.einsum("wbm,bmj->wbj", on_side, accelerations), np.s_[:]
        on_state.append(xp.einsum("wbm,lpbmj->lpwbj", on_side, transition[..., sides, :]))
        on_forces.append(xp.einsum("wbm,lpfbmk->lpwfbk", on_side, response[..., sides, :]))
        grouped.append(index)
    on_state, on_forces = xp.concatenate(on_state, axis=2), xp.concatenate(on_forces, axis=2)
    if len(grouped) > 1:
        as_given = np.argsort(np.concatenate(grouped))
        on_state, on_forces = on_state[:, :, as_given], on_forces[:, :, as_given]
    if corrected is not None:
        for order, extra in ((1, corrected.rates), (2, corrected.accelerations)):
            if extra is None:
                continue
            on_side, sides = extra.reshape(-1, blocks, count), np.s_[1 : 2 * count : 2]
            if order == 2:
                on_side, sides = xp.einsum("wbm,bmj->wbj", on_side, accelerations), np.s_[:]
            on_state = on_state + xp.einsum("wbm,lpbmj->lpwbj", on_side, transition[..., sides, :])
            added = xp.einsum("wbm,lpfbmk->lpwfbk", on_side, response[..., sides, :])
            on_forces = on_forces + added
    forces_at_once = _feedthrough(outputs, rows, command_rates, response.shape[-1], corrected)
    if forces_at_once is not None:
        weights = force_weights_at_peaks()[:, None, :, None, None]
        on_forces = on_forces + weights * forces_at_once[:, None]
    lengths = on_state.shape[0]
    return (
        on_state.reshape(lengths, -1, *on_state.shape[3:]),
        on_forces.reshape(lengths, -1, *on_forces.shape[3:]),
    )


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


def _feedthrough(
    outputs: OutputRows, rows, command_rates, input_count: int, corrected: CorrectionRows | None
):
    """Outputs per input at the same instant (output, block, input); None if they are all zero."""
    count = rows.shape[-1]
    has_commands = command_rates is not None and outputs.on_commands.shape[1] > 0
    has_masses = corrected is not None and corrected.accelerations is not None
    if not (outputs.has_feedthrough.any() or has_commands or has_masses):
        return None
    direct = xp.zeros((*rows.shape[:2], input_count))
    for i in np.flatnonzero(outputs.has_feedthrough):
        direct = add_at(direct, np.s_[i, :, :count], rows[i])
        if command_rates is not None:
            direct = add_at(direct, np.s_[i, :, count:], rows[i] @ command_rates)
    if has_commands:
        actuators = outputs.on_commands.shape[1]
        direct = add_at(direct, np.s_[:, 0, count : count + actuators], outputs.on_commands)
    if corrected is None:
        return direct
    if corrected.accelerations is not None:
        on_accelerations = corrected.accelerations.reshape(rows.shape)
        direct = add_at(direct, np.s_[..., :count], on_accelerations)
        if command_rates is not None:
            direct = add_at(direct, np.s_[:, :, count:], on_accelerations @ command_rates)
    if has_commands:
        direct = add_at(direct, np.s_[:, 0, count : count + actuators], corrected.commands)
    return direct


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
