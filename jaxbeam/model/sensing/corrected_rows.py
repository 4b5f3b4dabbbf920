"""Rows of section forces with their static correction, as linear outputs.

For deck accelerations of railway bridges: frequencies up to the largest of 30 Hz, 1.5 f_1 and f_3.

The residual of the modes responds to the forces on the beam at once (see `static_correction`):

    y = row . q + sum_l (G(x, x_l) - row . K^-1 psi(x_l)) F_l + (residual of dampers and actuators),

with the exact influence G of a force F_l at x_l on the quantity at x. The last are rows on rates,
accelerations and commands; the residual of the loads depends on where they are.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from numpy.polynomial import chebyshev

from jaxbeam.case.case import Case
from jaxbeam.case.quantities import quantity_of
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.flexibility import Flexibility, flexibility
from jaxbeam.model.layout import is_uniform
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Modes
from jaxbeam.model.sensing.output_rows import OutputRows, beside, quantity_factor, row_on_states
from jaxbeam.model.static_correction import (
    is_supported,
    residual_flexibility,
    residual_port_flexibility,
)
from jaxbeam.model.theory.statics import SectionFlexibility
from jaxbeam.numerics.piecewise import chebyshev_polynomials, piecewise_chebyshev
from jaxbeam.runtime.arrays import Array, set_at, solve, take, xp
from jaxbeam.runtime.module import Module

SIDE_SHIFT = 0.01  # towards a position nearby, by which the side of a break is found,
LARGEST_SHIFT = 0.1  # over the length of the beam and the root of the rounding error, at most
PARTS, PART_TERMS = 8, 24  # in which influence functions that are no cubics are interpolated


class CorrectionRows(Module):
    """Rows of the static correction of outputs; zero for those that are not corrected.

    On the rates q' and accelerations q'' of the modes (None without dampers and masses of supports
    and actuators), and on `commands`.
    """

    rates: Float[Array, "output mode"] | None
    accelerations: Float[Array, "output mode"] | None
    commands: Float[Array, "output actuator"]


class LoadInfluence(Module):
    """Static influence of a force on outputs, less that of the modes, over its position.

    Chebyshev `series` of the outputs per newton upwards between the `breaks` (m): nodes of the
    beam, and the outputs, at which moments have kinks and shear forces jump. `mirrored` outputs are
    those, then their negatives.
    """

    breaks: Float[Array, " break"]
    series: Float[Array, "piece term output"]
    mirrored: bool = eqx.field(static=True, default=False)

    def of_forces_at(
        self,
        x: Float[Array, "*position"],
        near: Float[Array, "*position"],
        output: Int[Array, "*position"] | None = None,
    ) -> Float[Array, "..."]:
        """Outputs (*position, output) per newton upwards at positions x (m).

        Off the beam as at its nearer end. At a break the limit on the side of it on which `near`
        (m) is. Only one `output` at each position, if its number is given: (*position,).
        """
        # Further breaks may lie between a position and one nearby.
        largest = LARGEST_SHIFT * np.finfo(x.dtype).eps ** 0.5 * self.breaks[-1]
        toward = x + xp.clip(SIDE_SHIFT * (near - x), -largest, largest)
        piece = xp.sum(toward[..., None] >= self.breaks[1:-1], axis=-1)
        left, right = take(self.breaks, piece), take(self.breaks, piece + 1)
        width = xp.where(right > left, right - left, 1.0)
        local = xp.clip((2 * x - left - right) / width, -1.0, 1.0)
        table = chebyshev_polynomials(local, self.series.shape[1])
        if output is not None:
            return xp.sum(table * self.series[piece, :, output], axis=-1)
        influence = xp.einsum("...k,...ko->...o", table, take(self.series, piece))
        return xp.concatenate([influence, -influence], -1) if self.mirrored else influence

    def plus(self, other: "LoadInfluence") -> "LoadInfluence":
        """Sum with another, whose breaks are among those of this one."""

        def values(x):
            return other.of_forces_at(x, x)

        added = _to_series(self.breaks, self.series.shape[1], values)
        return eqx.tree_at(lambda one: one.series, self, self.series + added)


def _to_series(breaks, terms: int, function: Callable) -> Float[Array, "piece term output"]:
    """Chebyshev series between breaks (m) through the values (..., output) of a function."""
    points = chebyshev.chebpts1(terms)
    middle, half = (breaks[1:] + breaks[:-1]) / 2, xp.diff(breaks) / 2
    values = function(middle[:, None] + half[:, None] * points)
    scale = np.where(np.arange(terms) == 0, 1.0, 2.0)[:, None] / terms
    to_series = scale * chebyshev.chebvander(points, terms - 1).T
    return xp.einsum("kp,spo->sko", to_series, values)


def load_influence(
    case: Case,
    modes: Modes,
    on_modes: Float[Array, "mode output"],
    greens: Sequence[tuple[Flexibility | SectionFlexibility, Float[Array, " _"], Sequence[int]]],
) -> LoadInfluence:
    """Influence of forces on outputs, from influence functions less that of the modes.

    `greens` are influence functions, factors from them to the quantities, and the indices of their
    outputs; the amplitudes of the modes have the influence `on_modes`. Between the breaks both are
    polynomials on a uniform beam; on others, smooth functions, interpolated in parts.
    """
    uniform, terms = is_uniform(case), max(4, modes.series.shape[1])
    breakpoints = [modes.nodes / case.beam.length, *(one.breakpoints for one, _, _ in greens)]
    if not uniform:
        breakpoints.append(np.linspace(0.0, 1.0, PARTS + 1))
    breaks = case.beam.length * xp.sort(xp.clip(xp.concatenate(breakpoints), 0.0, 1.0))
    terms = terms if uniform else max(terms, PART_TERMS)

    def influence(x):
        values = -piecewise_chebyshev(modes.nodes, modes.series @ on_modes, x, (0,))[0]
        for one, factor, index in greens:
            at = np.s_[..., np.array(index, int)]
            values = set_at(values, at, values[at] + factor * one(x / case.beam.length))
        return values

    return LoadInfluence(breaks, _to_series(breaks, terms, influence))


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
    orders = {i: quantity_of(*_channel(sensors[i])).x_derivative for i in bending}
    groups = {
        order: [i for i in bending if orders[i] == order] for order in sorted(set(orders.values()))
    }
    all_greens, factors = [], []
    length = case.beam.length
    for order, index in groups.items():
        x = beside(case, xp.stack([sensors[i].position for i in index]))
        own = xp.stack([_factor(case, sensors[i], x[n]) for n, i in enumerate(index)])
        all_greens.append(flexibility(case, layout, x, order))
        factors.append(own * length ** (3 - order) / case.beam.bending_stiffness)
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
        influence = LoadInfluence(model.modes.nodes, model.modes.series @ on_modes)
    if correction is not None:
        influence = correction.influence.plus(influence)
    return LinearOutputs(xp.array(rows).reshape(count, model.state_count), influence)
