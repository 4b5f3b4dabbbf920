"""Output rows: measured quantities as linear functions of the modal coordinates q.

    y_i = row_i . d^n q / dt^n,    row_i = d^k psi / dx^k at x_i, times -z_i for a fibre,

where k and n are the orders of derivation of `case.quantities`. Deflection and velocity follow
from the states; an acceleration follows from their rates, hence also from contact forces and
commands.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.quantities import quantity_of
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Modes
from jaxbeam.runtime.arrays import Array, set_at, xp
from jaxbeam.runtime.module import Module

# Positions x (m) and orders of derivation to the shapes (order, *position, mode), as
# `ModalModel.shapes` and `Modes.shape_derivatives`.
Shapes = Callable[..., Float[Array, "order *position mode"]]


def modal_row(shapes: Shapes, x, name: str, fibre_distance=None) -> Float[Array, "*position mode"]:
    """Rows that take d^n q / dt^n to a quantity at positions x (m).

    Raises ValueError for an unknown quantity, or a missing `fibre_distance` (m).
    """
    quantity = quantity_of(name, fibre_distance)
    row = shapes(x, (quantity.x_derivative,))[0]
    return -xp.asarray(fibre_distance)[..., None] * row if quantity.at_fibre else row


class OutputRows(Module):
    """Rows of outputs on q, q' or q'', by the order of the time derivative of each (0 to 2)."""

    rows: Float[Array, "output mode"]
    time_derivatives: tuple[int, ...] = eqx.field(static=True)

    @property
    def has_feedthrough(self) -> np.ndarray:
        """Whether forces and commands change an output at once, (output,): accelerations."""
        return np.array([order == 2 for order in self.time_derivatives], bool)

    def on_states(
        self, model: ModalModel
    ) -> tuple[Float[Array, "output state"], Float[Array, "output state"]]:
        """C and C' of y = C z + C' z', z being the states of the model."""
        C = xp.zeros((len(self.time_derivatives), model.state_count))
        on_rates = C
        for i, order in enumerate(self.time_derivatives):
            if order < 2:
                C = set_at(C, i, row_on_states(model, self.rows[i], order))
            else:
                on_rates = set_at(on_rates, i, row_on_states(model, self.rows[i], 1))
        return C, on_rates

    def of_system(
        self, model: ModalModel, A: Float[Array, "state state"], B: Float[Array, "state input"]
    ) -> tuple[Float[Array, "output state"], Float[Array, "output input"]]:
        """C and D of y = C z + D u where z' = A z + B u; the states are those of the model."""
        C, _ = self.on_states(model)
        D = xp.zeros((C.shape[0], B.shape[1]))
        rates = model.rate_index
        for i in np.flatnonzero(self.has_feedthrough):
            C, D = set_at(C, i, self.rows[i] @ A[rates]), set_at(D, i, self.rows[i] @ B[rates])
        return C, D

    def with_accelerations(
        self, outputs: Float[Array, "output *batch"], accelerations: Float[Array, "mode *batch"]
    ) -> Float[Array, "output *batch"]:
        """Outputs whose entries with feedthrough follow from modal accelerations q''."""
        for i in np.flatnonzero(self.has_feedthrough):
            outputs = set_at(outputs, i, self.rows[i] @ accelerations)
        return outputs


def sensor_rows(model: ModalModel, sensors: Sequence[Sensor]) -> OutputRows:
    """Output rows of the sensors, as ideal ones, on the coordinates of a modal model."""
    quantities = [quantity_of(s.quantity, s.fibre_distance) for s in sensors]
    rows = [modal_row(model.shapes, s.position, s.quantity, s.fibre_distance) for s in sensors]
    return OutputRows(
        xp.array(rows).reshape(len(rows), model.mode_count),
        tuple(quantity.time_derivative for quantity in quantities),
    )


def row_on_states(
    model: ModalModel, row: Float[Array, " mode"], time_derivative: int
) -> Float[Array, " state"]:
    """A row on q (time derivative 0) or q' (1) as a row on the states of the model."""
    index = model.rate_index if time_derivative else model.coordinate_index
    return set_at(xp.zeros(model.state_count), index, row)


def quantity_history(
    modes: Modes, modal_histories: Sequence[Float[Array, "time mode"]], x, name: str, fibre_distance
) -> Float[Array, "time *position"]:
    """History of a quantity at positions x (m) from modal amplitudes, their rates and so on.

    Raises ValueError for an unknown quantity, or a missing `fibre_distance` (m).
    """
    rows = modal_row(modes.shape_derivatives, x, name, fibre_distance)
    amplitudes = modal_histories[quantity_of(name, fibre_distance).time_derivative]
    return xp.tensordot(amplitudes, rows, axes=[1, -1])
