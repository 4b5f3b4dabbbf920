"""Rows of what sensors measure on the beam, in the band of modes that counts.

    y_i = row_i . d^n q / dt^n,    row_i = d^k psi / dx^k at x_i, times -z_i for a fibre,

where k and n are the orders of derivation of `case.quantities`; section forces have the factor E I
too. Deflection and velocity follow from the states; an acceleration follows from their rates, hence
also from contact forces and commands. Rows are those of the modes; histories of curvature, strain
and section forces are statically corrected.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.quantities import QUANTITIES, Quantity, quantity_of
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Modes
from jaxbeam.model.static_correction import (
    Motion,
    active_moments,
    corrected_history,
    section_stiffness,
)
from jaxbeam.runtime.arrays import Array, set_at, xp
from jaxbeam.runtime.module import Module

LEAST_FREQUENCY = 30.0  # Hz
FIRST_MODE_FACTOR = 1.5
MODES_AT_LEAST = 3
ROUNDING = 1e-9  # of a frequency


def counted_frequency(frequencies: Float[Array, " mode"]) -> Float[Array, ""]:
    """Frequency (Hz) up to which modes count: the largest of 30 Hz, 1.5 f_1 and f_3.

    `frequencies` (Hz) ascend.
    """
    third = frequencies[min(MODES_AT_LEAST, frequencies.shape[0]) - 1]
    limit = xp.maximum(LEAST_FREQUENCY, FIRST_MODE_FACTOR * frequencies[0])
    return xp.maximum(limit, third) * (1 + ROUNDING)


def band_weights(modes: Modes, band: str) -> Float[Array, " mode"]:
    """1 for the modes of a band ("all" or "en1990"), 0 for the others."""
    frequencies = modes.frequencies
    if band == "all":
        return xp.ones(frequencies.shape)
    return xp.where(frequencies <= counted_frequency(frequencies), 1.0, 0.0)


def banded_fields(model: ModalModel, band: str):
    """Function like `ModalModel.fields` without the modes outside a band."""
    if band == "all":
        return model.fields
    weights = band_weights(model.modes, band)

    def fields(x, orders: tuple[int, ...]):
        rows = model.modes.fields(x, orders) * weights
        return rows if model.mode_map is None else rows @ model.mode_map

    return fields


# Positions x (m) and orders of fields to their rows (order, *position, mode), as
# `ModalModel.fields` and `Modes.fields`.
Fields = Callable[..., Float[Array, "order *position mode"]]

SIDE_SHARE = 1e-12  # of the length: distance from a position to a section beside it


def modal_row(
    fields: Fields, case: Case, x, name: str, fibre_distance=None, section_modulus=None
) -> Float[Array, "*position mode"]:
    """Rows that take d^n q / dt^n to a quantity at positions x (m), static correction excluded.

    Raises ValueError for an unknown quantity, a missing `fibre_distance` (m) or `section_modulus`
    (m^3).
    """
    parameters = fibre_distance, section_modulus
    quantity = quantity_of(name, *parameters)
    row = fields(x, (quantity.field,))[0]
    return quantity_factor(case, x, quantity, *parameters)[..., None] * row


def quantity_factor(case: Case, x, quantity: Quantity, fibre_distance, section_modulus):
    """Factor from the derivative of the deflection at positions x (m) to a quantity."""
    factor = section_stiffness(case, x) if quantity.section_force else xp.ones(())
    if quantity.at_fibre:
        factor = -xp.asarray(fibre_distance) * factor
    return factor / xp.asarray(section_modulus) if quantity.over_modulus else factor


class OutputRows(Module):
    """Rows of outputs on q, q' or q'', by the order of the time derivative of each (0 to 2).

    `on_commands` are the active moments in the sections whose moment or stress is an output.
    """

    rows: Float[Array, "output mode"]
    on_commands: Float[Array, "output actuator"]
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
        self,
        model: ModalModel,
        A: Float[Array, "*time state state"],
        B: Float[Array, "*time state input"],
    ) -> tuple[Float[Array, "*time output state"], Float[Array, "*time output input"]]:
        """C and D of y = C z + D u where z' = A z + B u; the first states are those of the model.

        Commands are the first of the inputs.
        """
        C, _ = self.on_states(model)
        C = xp.pad(C, ((0, 0), (0, A.shape[-1] - C.shape[1])))
        C = xp.broadcast_to(C, (*A.shape[:-2], *C.shape))
        D = xp.zeros((*C.shape[:-1], B.shape[-1]))
        D = set_at(D, np.s_[..., : self.on_commands.shape[1]], self.on_commands)
        rates = model.rate_index
        for i in np.flatnonzero(self.has_feedthrough):
            C = set_at(C, np.s_[..., i, :], self.rows[i] @ A[..., rates, :])
            D = set_at(D, np.s_[..., i, :], self.rows[i] @ B[..., rates, :])
        return C, D

    def with_accelerations(
        self, outputs: Float[Array, "output *batch"], accelerations: Float[Array, "mode *batch"]
    ) -> Float[Array, "output *batch"]:
        """Outputs whose entries with feedthrough follow from modal accelerations q''."""
        for i in np.flatnonzero(self.has_feedthrough):
            outputs = set_at(outputs, i, self.rows[i] @ accelerations)
        return outputs


def sensor_rows(model: ModalModel, case: Case, sensors: Sequence[Sensor]) -> OutputRows:
    """Output rows of sensors on a case, as ideal ones, on the coordinates of its modal model."""
    alike: dict[tuple[str, str], list[int]] = {}
    for i, sensor in enumerate(sensors):
        alike.setdefault((sensor.quantity, sensor.mode_band), []).append(i)
    rows, on_commands = [xp.zeros((0, model.mode_count))], [xp.zeros((0, len(case.actuators)))]
    for (name, band), index in alike.items():
        x, fibre_distance, section_modulus = (
            _stacked([getattr(sensors[i], field) for i in index])
            for field in ("position", "fibre_distance", "section_modulus")
        )
        quantity = quantity_of(name, fibre_distance, section_modulus)
        fields = banded_fields(model, band)
        rows.append(modal_row(fields, case, x, name, fibre_distance, section_modulus))
        active = active_moments(case, x).T
        if not quantity.has_active_moment:
            active = xp.zeros_like(active)
        elif quantity.over_modulus:
            active = active / section_modulus[:, None]
        on_commands.append(active)
    order = np.argsort(np.array(sum(alike.values(), []), int))
    return OutputRows(
        xp.concatenate(rows)[order],
        xp.concatenate(on_commands)[order],
        tuple(QUANTITIES[sensor.quantity].time_derivative for sensor in sensors),
    )


def _stacked(values):
    """Values of some sensors as an array; None where one of them has none."""
    return None if any(value is None for value in values) else xp.stack(values)


def row_on_states(
    model: ModalModel, row: Float[Array, " mode"], time_derivative: int
) -> Float[Array, " state"]:
    """A row on q (time derivative 0) or q' (1) as a row on the states of the model."""
    index = model.rate_index if time_derivative else model.coordinate_index
    return set_at(xp.zeros(model.state_count), index, row)


def quantity_history(
    case: Case,
    modes: Modes,
    motion: Motion,
    x,
    name: str,
    fibre_distance=None,
    section_modulus=None,
    mode_band: str = "all",
) -> Float[Array, "time *position"]:
    """History of a quantity at positions x (m) from the motion of the modes (of a band).

    Curvature and what follows from it are statically corrected (see `corrected_history`); at a load
    or support, and at the end of a patch, the shear force to the right of it. Raises ValueError for
    an unknown quantity, a missing `fibre_distance` (m) or `section_modulus` (m^3).
    """
    parameters = fibre_distance, section_modulus
    quantity = quantity_of(name, *parameters)
    if not quantity.bends:
        rows = modal_row(modes.fields, case, x, name, *parameters) * band_weights(modes, mode_band)
        amplitudes = (motion.coordinates, motion.rates, motion.accelerations)
        return xp.tensordot(amplitudes[quantity.time_derivative], rows, axes=[1, -1])
    x = beside(case, x)
    history = corrected_history(case, modes, motion, x, quantity.x_derivative)
    history = quantity_factor(case, x, quantity, *parameters) * history
    if quantity.has_active_moment and case.actuators:
        modulus = xp.asarray(section_modulus) if quantity.over_modulus else 1.0
        active = xp.tensordot(motion.command, active_moments(case, x), axes=1)
        history = history + active / modulus
    return history


def sensor_history(
    case: Case, modes: Modes, motion: Motion, sensor: Sensor
) -> Float[Array, " time"]:
    """History of the true quantity of a sensor, in its SI unit; see `quantity_history`."""
    channel = sensor.position, sensor.quantity, sensor.fibre_distance, sensor.section_modulus
    return quantity_history(case, modes, motion, *channel, sensor.mode_band)


def beside(case: Case, x, side: str = "right") -> Float[Array, "*position"]:
    """Positions just right or left of x (m), by SIDE_SHARE of the length, within the beam.

    Third derivatives jump at loads and supports, curvatures at the ends of patches.
    """
    step = SIDE_SHARE * case.beam.length
    shifted = xp.asarray(x, float) + (step if side == "right" else -step)
    return xp.clip(shifted, step, case.beam.length - step)
