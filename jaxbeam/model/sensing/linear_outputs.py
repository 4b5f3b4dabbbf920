"""Outputs as linear functions of the state of the beam and of the forces of its loads."""

from jaxtyping import Float

from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.corrected_rows import LoadInfluence, StaticCorrection
from jaxbeam.model.sensing.output_rows import OutputRows, row_on_states
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.module import Module


class LinearOutputs(Module):
    """Outputs y = rows z + sum over the loads of influence(x) F, without commands.

    z are the states of the model, F the forces (N, upwards) of loads at x; `influence` is None
    where they do not change the outputs at once.
    """

    rows: Float[Array, "output state"]
    influence: LoadInfluence | None


def linear_outputs(
    model: ModalModel, outputs: OutputRows, correction: StaticCorrection | None
) -> LinearOutputs:
    """Outputs on the states of a model and on the forces of loads, with their static correction.

    An acceleration is that of the free beam, A z, and that of the forces on the modes.
    """
    at_rates = model.A[model.rate_index]
    rows, on_accelerations = [], []
    for i, order in enumerate(outputs.time_derivatives):
        own, by_forces = outputs.rows[i], xp.zeros(model.mode_count)
        row = own @ at_rates if order == 2 else row_on_states(model, own, order)
        if order == 2:
            by_forces = by_forces + own
        if correction is not None and correction.rows.rates is not None:
            row = row + row_on_states(model, correction.rows.rates[i], 1)
        if correction is not None and correction.rows.accelerations is not None:
            row = row + correction.rows.accelerations[i] @ at_rates
            by_forces = by_forces + correction.rows.accelerations[i]
        rows.append(row)
        on_accelerations.append(by_forces)
    count = len(outputs.time_derivatives)
    on_modes = xp.array(on_accelerations).reshape(count, model.mode_count).T
    if model.mode_map is not None:
        on_modes = model.mode_map @ on_modes
    influence = None
    if correction is not None or outputs.has_feedthrough.any():
        influence = LoadInfluence(model.modes.nodes, model.modes.series @ on_modes)
    if correction is not None:
        influence = correction.influence.plus(influence)
    return LinearOutputs(xp.array(rows).reshape(count, model.state_count), influence)
