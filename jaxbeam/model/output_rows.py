"""Output rows of sensors on the modal states, within a band of modes, statically corrected.

    y_i = row_i . d^n q / dt^n,    row_i = d^k psi / dx^k at x_i, times -z_i for a fibre,

where k and n are the orders of derivation of `case.sensors`; section forces have the factor E I
too. Deflection and velocity follow from the states; an acceleration follows from their rates, hence
also from contact forces and commands. Rows are those of the modes; histories of curvature, strain
and section forces are statically corrected, and so are the `linear_outputs` of section forces. The
band "en1990", for deck accelerations of railway bridges, has the frequencies up to the largest of
30 Hz, 1.5 f_1 and f_3. The residual of the modes responds to the forces on the beam at once (see
`static_correction`):

    y = row . q + sum_l (G(x, x_l) - row . K^-1 psi(x_l)) F_l + (residual of dampers and actuators),

with the exact influence G of a force F_l at x_l on the quantity at x. The last are rows on rates,
accelerations and commands; the residual of the loads depends on where they are.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.sensors import QUANTITIES, TWIST, TWIST_RATE, Quantity, Sensor, quantity_of
from jaxbeam.model.deflection_lines import LoadInfluence, influence_functions, load_influence
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Modes
from jaxbeam.model.static_correction import (
    OF_TWIST,
    Motion,
    active_moments,
    corrected_history,
    is_supported,
    residual_flexibility,
    residual_port_flexibility,
    section_stiffness,
)
from jaxbeam.runtime.arrays import Array, Module, set_at, solve, xp

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

SIDE_DISTANCE = 1e-12  # from a position to the section next to it, over the length


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


def sensor_row(
    fields: Fields, case: Case, sensor: Sensor, x: Float[Array, ""]
) -> Float[Array, " mode"]:
    """Row of a sensor that takes d^n q / dt^n to its quantity at x (m); see `modal_row`."""
    row = modal_row(fields, case, x, *_channel(sensor))
    if sensor.eccentricity is None:
        return row
    return row + sensor.eccentricity * fields(x, (TWIST,))[0]


def quantity_factor(case: Case, x, quantity: Quantity, fibre_distance, section_modulus):
    """Factor from the derivative of the deflection at positions x (m) to a quantity."""
    factor = section_stiffness(case, x) if quantity.section_force else xp.ones(())
    if quantity.field == TWIST_RATE:
        factor = case.beam.torsional_rigidity * xp.ones(xp.shape(x))
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
    alike: dict[tuple[str, str, str], list[int]] = {}
    for i, sensor in enumerate(sensors):
        alike.setdefault((sensor.quantity, sensor.mode_band, sensor.side), []).append(i)
    rows, on_commands = [xp.zeros((0, model.mode_count))], [xp.zeros((0, len(case.actuators)))]
    for (name, band, side), index in alike.items():
        x, fibre_distance, section_modulus = (
            _stacked([getattr(sensors[i], field) for i in index])
            for field in ("position", "fibre_distance", "section_modulus")
        )
        quantity = quantity_of(name, fibre_distance, section_modulus)
        x = at_side(case, x, side) if side else x
        fields = banded_fields(model, band)
        found = modal_row(fields, case, x, name, fibre_distance, section_modulus)
        arms = [sensors[i].eccentricity for i in index]
        if any(arm is not None for arm in arms):
            arms = xp.stack([xp.asarray(0.0 if arm is None else arm) for arm in arms])
            found = found + arms[:, None] * fields(x, (TWIST,))[0]
        rows.append(found)
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
    side: str = "",
) -> Float[Array, "time *position"]:
    """History of a quantity at positions x (m) from the motion of the modes (of a band).

    Curvature and what follows from it are statically corrected (see `corrected_history`). What
    jumps at x, as a shear force at a load or support, is that on one side, by default the right
    one. Raises ValueError for an unknown quantity, a missing `fibre_distance` (m) or
    `section_modulus` (m^3).
    """
    parameters = fibre_distance, section_modulus
    quantity = quantity_of(name, *parameters)
    jumps = quantity.bends or (side and quantity.x_derivative)
    x = at_side(case, x, side or "right") if jumps else x
    if not quantity.bends:
        rows = modal_row(modes.fields, case, x, name, *parameters) * band_weights(modes, mode_band)
        amplitudes = (motion.coordinates, motion.rates, motion.accelerations)
        return xp.tensordot(amplitudes[quantity.time_derivative], rows, axes=[1, -1])
    history = corrected_history(case, modes, motion, x, quantity.field)
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
    if sensor.eccentricity is not None:
        row = sensor_row(modes.fields, case, sensor, sensor.position)
        amplitudes = (motion.coordinates, motion.rates, motion.accelerations)
        derivative = QUANTITIES[sensor.quantity].time_derivative
        return amplitudes[derivative] @ (row * band_weights(modes, sensor.mode_band))
    channel = sensor.position, *_channel(sensor)
    return quantity_history(case, modes, motion, *channel, sensor.mode_band, sensor.side)


def place_of(case: Case, sensor: Sensor) -> Float[Array, ""]:
    """Position (m) at which a sensor's quantity is taken: next to its own where it may jump."""
    if sensor.side or sensor.bends:
        return at_side(case, sensor.position, sensor.side or "right")
    return sensor.position


def at_side(case: Case, x, side: str = "right") -> Float[Array, "*position"]:
    """Positions just right or left of x (m), by SIDE_DISTANCE of the length, within the beam.

    Third derivatives jump at loads and supports, curvatures at the ends of patches.
    """
    step = SIDE_DISTANCE * case.beam.length
    shifted = xp.asarray(x, float) + (step if side == "right" else -step)
    return xp.clip(shifted, step, case.beam.length - step)


class CorrectionRows(Module):
    """Rows of the static correction of outputs; zero for those that are not corrected.

    On the rates q' and accelerations q'' of the modes (None without dampers and masses of supports
    and actuators), and on `commands`.
    """

    rates: Float[Array, "output mode"] | None
    accelerations: Float[Array, "output mode"] | None
    commands: Float[Array, "output actuator"]


class StaticCorrection(Module):
    """Static correction of outputs: rows, and the influence of forces of the loads."""

    rows: CorrectionRows
    influence: LoadInfluence


def static_correction(
    model: ModalModel,
    case: Case,
    sensors: Sequence[Sensor],
    outputs: OutputRows,
) -> StaticCorrection | None:
    """Static correction of the `outputs` of sensors, in the coordinates of their modal model.

    None where no sensor measures a curvature, strain or section force, and for beams that can move
    as a rigid body.
    """
    bending = [i for i, sensor in enumerate(sensors) if sensor.bends]
    layout = model.modes.layout
    if not bending or not is_supported(case, layout):
        return None
    count, modes = len(sensors), model.mode_count
    of_modes = solve(model.stiffness(), outputs.rows.T)
    if model.mode_map is not None:
        of_modes = model.mode_map @ of_modes
    of_modes = xp.where(np.isin(np.arange(count), bending), of_modes, 0.0)
    rates = accelerations = xp.zeros((count, modes))
    commands = xp.zeros((count, len(case.actuators)))
    orders = {i: quantity_of(*_channel(sensors[i])).field for i in bending}
    groups = {
        order: [i for i in bending if orders[i] == order] for order in sorted(set(orders.values()))
    }
    all_greens, factors = [], []
    length = case.beam.length
    for order, index in groups.items():
        x = xp.stack([place_of(case, sensors[i]) for i in index])
        own = xp.stack([_factor(case, sensors[i], x[n]) for n, i in enumerate(index)])
        all_greens.append(influence_functions(case, layout, x, order))
        factors.append(own * length ** (3 - abs(order)) / case.beam.bending_stiffness)
        if order in OF_TWIST:  # dampers and actuators are on the axis
            continue
        for support in case.supports:
            if support.damping is None:
                continue
            residual = own * residual_flexibility(case, x, support.position, order, layout)
            shape = model.shapes(support.position, (0,))[0]
            rates = _added(rates, index, residual[:, None] * support.damping * shape)
        if case.actuators:
            per_force = own * residual_port_flexibility(case, x, order, layout)
            for i, actuator in enumerate(case.actuators):
                attachment, shape = actuator.attachment(), model.displacement_map[i]
                residual = per_force[i][:, None]
                rates = _added(rates, index, -residual * attachment.damping * shape)
                if attachment.mass is not None:
                    added = -residual * attachment.mass * shape
                    accelerations = _added(accelerations, index, added)
                gain = per_force[i] * attachment.static_gain
                commands = set_at(commands, (np.array(index), i), gain)
    is_damped = case.actuators or any(s.damping is not None for s in case.supports)
    has_masses = any(a.attachment().mass is not None for a in case.actuators)
    rows = CorrectionRows(
        rates if is_damped else None, accelerations if has_masses else None, commands
    )
    greens = list(zip(all_greens, factors, groups.values(), strict=True))
    influence = load_influence(case, model.modes, of_modes, greens)
    if case.track is not None:
        influence = influence.spread(case.track.kernel())
    return StaticCorrection(rows, influence)


def _channel(sensor: Sensor):
    return sensor.quantity, sensor.fibre_distance, sensor.section_modulus


def _factor(case: Case, sensor: Sensor, x):
    """Factor from the derivative of the deflection to the quantity of a sensor at x (m)."""
    _, *parameters = _channel(sensor)
    return quantity_factor(case, x, quantity_of(*_channel(sensor)), *parameters) * xp.ones(())


def _added(rows, index, values):
    return set_at(rows, np.array(index), rows[np.array(index)] + values)


def corrected_places(
    case: Case, model: ModalModel, sensors: Sequence[Sensor]
) -> Float[Array, " place"] | None:
    """Positions (m) of the sensors whose peaks are statically corrected; None without any.

    There the influence of a load has a kink or a jump, so that steps end where a wheel passes.
    """
    places = [sensor.position for sensor in sensors if sensor.bends]
    return xp.stack(places) if places and is_supported(case, model.modes.layout) else None


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
        twist = None if model.load_twist is None else model.load_twist @ on_modes
        influence = LoadInfluence(model.load_nodes, model.load_series @ on_modes, twist=twist)
    if correction is not None:
        influence = correction.influence.plus(influence)
    return LinearOutputs(xp.array(rows).reshape(count, model.state_count), influence)
