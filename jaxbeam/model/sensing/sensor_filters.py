"""Modal model augmented by the analogue filters of its sensors and of the controller."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import ControllerFilter
from jaxbeam.case.filters import analogue_state_space
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.output_rows import sensor_rows
from jaxbeam.model.state_space import Plant
from jaxbeam.runtime.arrays import Array, add_at, block_diag, set_at, xp


def with_sensor_filters(
    plant: Plant, controller_filters: Sequence[ControllerFilter] = ()
) -> tuple[ModalModel, Float[Array, "sensor state"]]:
    """Modal model with states of the analogue filters, and rows from its states to their outputs.

    Rows are those of the sensors, then those of the filters of a control law. Rows of acceleration
    sensors are zero: accelerations depend on contact forces and commands too.
    """
    case, model = plant.case, plant.modal_model
    state_matrices, filter_inputs, rows = [model.A], [], []
    on_states, _ = sensor_rows(model, case, case.sensors).on_states(model)
    for sensor, row in zip(case.sensors, on_states, strict=True):
        if sensor.filter is None or sensor.filter.realisation != "analogue":
            rows.append({0: row})
            continue
        matrix, column, output, _ = analogue_state_space(sensor.filter)
        filter_inputs.append((len(state_matrices), column, {0: row}))
        rows.append({len(state_matrices): output})
        state_matrices.append(matrix)
    for controller_filter in controller_filters:
        filter_input = rows[controller_filter.sensor]
        filter_inputs.append((len(state_matrices), controller_filter.B, filter_input))
        rows.append(
            {part: controller_filter.D * row for part, row in filter_input.items()}
            | {len(state_matrices): controller_filter.C}
        )
        state_matrices.append(controller_filter.A)
    first_states = np.cumsum([0, *(part.shape[0] for part in state_matrices)])
    total = int(first_states[-1])

    def expand(row):
        """A row on the states of some parts as a row on all states."""
        row_parts = [row.get(i, xp.zeros(part.shape[0])) for i, part in enumerate(state_matrices)]
        return xp.concatenate(row_parts)

    state_matrix = block_diag(*state_matrices)
    for i, column, row in filter_inputs:
        state_matrix = add_at(
            state_matrix,
            np.s_[first_states[i] : first_states[i + 1]],
            xp.outer(column, expand(row)),
        )
    filter_input = xp.stack([expand(row) for row in rows]) if rows else xp.zeros((0, total))
    command_matrix = set_at(
        xp.zeros((total, model.command_matrix.shape[1])),
        np.s_[: model.state_count],
        model.command_matrix,
    )
    augmented = eqx.tree_at(
        lambda r: (r.state_matrix, r.command_matrix), model, (state_matrix[None], command_matrix)
    )
    return augmented, filter_input
