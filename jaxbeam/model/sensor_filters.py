"""The rig with the filters that act on what its sensors see before samples are taken of it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from jaxbeam.case.filters import analogue_state_space
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.state_space import Plant


def with_sensor_filters(plant: Plant) -> tuple[ModalModel, Float[Array, "sensor state"]]:
    """The rig with the states of its sensors' analogue filters, and what the sensors see of it.

    Rows of acceleration sensors are zero: they see forces too. States of filters that a controller
    brings along follow, and rows of their outputs.
    """
    case, model = plant.case, plant.modal_model
    state_count, modal_states = model.state_count, 2 * plant.coordinate_scale.shape[0]
    state_matrices, filter_inputs, rows = [model.state_matrix[0]], [], []
    for sensor in case.sensors:
        derivative = {"slope": 1, "strain": 2}.get(sensor.quantity, 0)
        shape = model.shapes(sensor.position, (derivative,))[0]
        if sensor.quantity == "strain":
            shape = -sensor.fibre_distance * shape
        if sensor.quantity == "acceleration":
            shape = jnp.zeros_like(shape)
        first_state = 1 if sensor.quantity == "velocity" else 0
        row = jnp.zeros(state_count).at[first_state:modal_states:2].set(shape)
        if sensor.filter is None or sensor.filter.realisation != "analogue":
            rows.append({0: row})
            continue
        matrix, column, output, _ = analogue_state_space(sensor.filter)
        filter_inputs.append((len(state_matrices), column, {0: row}))
        rows.append({len(state_matrices): output})
        state_matrices.append(matrix)
    for controller_filter in () if case.controller is None else case.controller.own_filters():
        filter_input = rows[controller_filter.sensor]
        filter_inputs.append((len(state_matrices), controller_filter.B, filter_input))
        rows.append(
            {place: controller_filter.D * row for place, row in filter_input.items()}
            | {len(state_matrices): controller_filter.C}
        )
        state_matrices.append(controller_filter.A)
    first_states = np.cumsum([0, *(part.shape[0] for part in state_matrices)])
    total = int(first_states[-1])

    def expand(row):
        """A row over some of the parts as one over all states."""
        row_parts = [row.get(i, jnp.zeros(part.shape[0])) for i, part in enumerate(state_matrices)]
        return jnp.concatenate(row_parts)

    state_matrix = block_diag(*state_matrices)
    for i, column, row in filter_inputs:
        state_matrix = state_matrix.at[first_states[i] : first_states[i + 1]].add(
            jnp.outer(column, expand(row))
        )
    filter_input = jnp.stack([expand(row) for row in rows]) if rows else jnp.zeros((0, total))
    command_matrix = (
        jnp.zeros((total, model.command_matrix.shape[1])).at[:state_count].set(model.command_matrix)
    )
    augmented = eqx.tree_at(
        lambda r: (r.state_matrix, r.command_matrix), model, (state_matrix[None], command_matrix)
    )
    return augmented, filter_input
