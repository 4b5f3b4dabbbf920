"""Discrete model: modal model on a time grid, with rows of monitored outputs."""

import dataclasses
import operator
from collections.abc import Callable

import equinox as eqx
from jaxtyping import Float

from jaxbeam.integrator.input_policy import AbstractInputPolicy
from jaxbeam.integrator.peaks.monitored_rows import (
    bounds_by_energy,
    commands_at_once,
    monitored_rows,
)
from jaxbeam.integrator.propagators import PEAK_NODES, Propagators, propagators
from jaxbeam.integrator.time_grid import TimeGrid
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.corrected_rows import LoadInfluence, StaticCorrection, linear_outputs
from jaxbeam.model.sensing.output_rows import OutputRows
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.module import Module


class DiscreteModel(Module):
    """Modal model on a time grid: propagators of each step length, rows of monitored outputs.

    Outputs are deflections, or other quantities of sensors. `energy_bounds` bound each of them by
    the energies of the blocks (see `bounds_by_energy`). With `with_node_states`, step matrices
    include the states at the nodes. `load_influence` is that of outputs that forces change at once.
    Peaks are those of the `magnitude` of an output, by default its absolute value.
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
    magnitude: Callable = eqx.field(static=True, default=abs)

    @property
    def position_count(self) -> int:
        """Number of monitored positions."""
        return 0 if self.energy_bounds is None else self.energy_bounds.shape[0]


def discrete_model(
    model: ModalModel,
    grid: TimeGrid,
    positions: Float[Array, " position"] | None,
    policy: AbstractInputPolicy | None = None,
    outputs: OutputRows | None = None,
    correction: StaticCorrection | None = None,
) -> DiscreteModel:
    """Modal model on a time grid, with deflections monitored at `positions` (m), if any.

    An input policy adds the commands, and the states at the nodes if it is implicit. `outputs` are
    monitored in place of the deflections: sums of the modes, accelerations with the forces, and
    with their static `correction`, if it is given.
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
    """Same model with each position monitored twice: upward deflections, then downward ones."""

    def both_signs(rows):
        split = rows.reshape(
            rows.shape[0], len(PEAK_NODES), discrete.position_count, *rows.shape[2:]
        )
        both = xp.concatenate([split, -split], axis=2)
        return both.reshape(rows.shape[0], -1, *rows.shape[2:])

    influence = discrete.load_influence
    return dataclasses.replace(
        discrete,
        load_influence=influence and dataclasses.replace(influence, mirrored=True),
        monitored_transition=both_signs(discrete.monitored_transition),
        monitored_input=both_signs(discrete.monitored_input),
        energy_bounds=xp.tile(discrete.energy_bounds, (2, 1)),
        magnitude=operator.pos,
    )
