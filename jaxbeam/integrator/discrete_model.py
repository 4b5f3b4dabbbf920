"""Discrete model: modal model on a time grid, with rows of monitored deflections."""

import dataclasses
import operator
from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.input_policy import AbstractInputPolicy
from jaxbeam.integrator.propagators import PEAK_NODES, Propagators, propagators
from jaxbeam.integrator.time_grid import TimeGrid
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.arrays import Array, solve_triangular, xp


class DiscreteModel(eqx.Module):
    """Modal model on a time grid: propagators of each step length, rows of monitored deflections.

    `flexibility` is the static deflection (m/N) at each monitored position under a unit force
    there; it bounds the deflection by the energy. With `with_node_states`, step matrices include
    the states at the nodes. Peaks are those of the `magnitude` of a deflection, by default its
    absolute value.
    """

    model: ModalModel
    grid: TimeGrid
    propagators: Propagators
    monitored_transition: Float[Array, "length sample block side"] | None
    monitored_input: Float[Array, "length sample force block input"] | None
    flexibility: Float[Array, " position"] | None
    modal_command_matrix: Float[Array, "mode actuator"] | None
    with_node_states: bool = eqx.field(static=True)
    magnitude: Callable = eqx.field(static=True, default=abs)

    @property
    def position_count(self) -> int:
        """Number of monitored positions."""
        return 0 if self.flexibility is None else self.flexibility.shape[0]


def discrete_model(
    model: ModalModel,
    grid: TimeGrid,
    positions: Float[Array, " position"] | None,
    policy: AbstractInputPolicy | None = None,
) -> DiscreteModel:
    """Modal model on a time grid, with deflections monitored at `positions` (m), if any.

    An input policy adds the commands, and the states at the nodes if it is implicit.
    """
    with_commands = policy is not None
    with_node_states = policy is not None and policy.implicit
    step_propagators = propagators(model, grid.lengths, with_commands)
    modes_per_block = model.modes_per_block
    commands = model.command_matrix[1 : 2 * modes_per_block : 2] if with_commands else None
    if positions is None:
        return DiscreteModel(
            model, grid, step_propagators, None, None, None, commands, with_node_states
        )
    blocks = model.state_matrix.shape[0]
    shapes = model.shapes(positions, (0,))[0]
    rows = shapes.reshape(-1, blocks, modes_per_block)
    transitions, force_responses = _peak_node_rows(
        step_propagators, np.arange(0, 2 * modes_per_block, 2)
    )
    deflection_transition = xp.einsum("wbm,lpbmj->lpwbj", rows, transitions)
    deflection_force_response = xp.einsum("wbm,lpfbmk->lpwfbk", rows, force_responses)
    flat_shape = (grid.lengths.shape[0], -1)
    return DiscreteModel(
        model,
        grid,
        step_propagators,
        deflection_transition.reshape(*flat_shape, *deflection_transition.shape[3:]),
        deflection_force_response.reshape(*flat_shape, *deflection_force_response.shape[3:]),
        _static_flexibility(model, shapes),
        commands,
        with_node_states,
    )


def _peak_node_rows(propagators: Propagators, rows):
    """Rows of the propagators (length, sample, ...) at the peak nodes of a step."""
    identity = xp.broadcast_to(
        xp.eye(propagators.transition_end.shape[-1]), propagators.transition_end.shape
    )
    transitions = xp.concatenate(
        [identity[:, None], propagators.transition_nodes, propagators.transition_end[:, None]],
        axis=1,
    )
    force_responses = (
        xp.zeros_like(propagators.input_end)[:, None],
        propagators.input_nodes,
        propagators.input_end[:, None],
    )
    return transitions[..., rows, :], xp.concatenate(force_responses, axis=1)[..., rows, :]


def _static_flexibility(
    model: ModalModel, shapes: Float[Array, "position mode"]
) -> Float[Array, " position"]:
    """Static deflection (m/N) at positions under a unit force; infinite with rigid-body modes.

    Uncoupled modes need no factorisation, which would dominate the time.
    """
    if model.modes_per_block == 1:
        return xp.sum(shapes**2 / -model.state_matrix[:, 1, 0], axis=1)
    half_solved = solve_triangular(xp.linalg.cholesky(model.stiffness()), shapes.T, lower=True)
    return xp.sum(half_solved**2, axis=0)


def signed_both_ways(discrete: DiscreteModel) -> DiscreteModel:
    """Same model with each position monitored twice: upward deflections, then downward ones."""

    def both_signs(rows):
        split = rows.reshape(
            rows.shape[0], len(PEAK_NODES), discrete.position_count, *rows.shape[2:]
        )
        both = xp.concatenate([split, -split], axis=2)
        return both.reshape(rows.shape[0], -1, *rows.shape[2:])

    return dataclasses.replace(
        discrete,
        monitored_transition=both_signs(discrete.monitored_transition),
        monitored_input=both_signs(discrete.monitored_input),
        flexibility=xp.tile(discrete.flexibility, 2),
        magnitude=operator.pos,
    )
