"""Static correction of output rows: curvature, strain and section forces beyond the modes kept.

The residual of the modes responds to the forces on the beam at once (see `static_correction`):

    y = row . q + sum_l (G(x, x_l) - row . K^-1 psi(x_l)) F_l + (residual of dampers and actuators),

with the exact influence G of a force F_l at x_l on the quantity at x. The last are rows on rates,
accelerations and commands; the residual of the loads depends on where they are.
"""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.quantities import quantity_of
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.flexibility import Flexibility, flexibility
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.output_rows import (
    SIDE_SHARE,
    OutputRows,
    beside,
    quantity_factor,
)
from jaxbeam.model.static_correction import (
    is_supported,
    residual_flexibility,
    residual_port_flexibility,
)
from jaxbeam.model.theory.statics import SectionFlexibility
from jaxbeam.numerics.piecewise import piecewise_chebyshev
from jaxbeam.runtime.arrays import Array, set_at, solve, xp
from jaxbeam.runtime.module import Module


class CorrectionRows(Module):
    """Rows of the static correction of outputs; zero for those that are not corrected.

    On the rates q' and accelerations q'' of the modes (None without dampers and masses of supports
    and actuators), and on `commands`.
    """

    rates: Float[Array, "output mode"] | None
    accelerations: Float[Array, "output mode"] | None
    commands: Float[Array, "output actuator"]


class LoadInfluence(Module):
    """Static influence of a force on outputs, less that of the modes; see `of_forces_at`.

    `greens` are for each order of derivation, with the indices of its outputs in `outputs`, and
    `factors` from them to the quantities per newton. The influence of the modes has the Chebyshev
    `series` between the `nodes` (m). At the `places` (m) of the outputs it has kinks or jumps.
    `mirrored` outputs are those, then their negatives.
    """

    places: Float[Array, " place"]

    nodes: Float[Array, " node"]
    series: Float[Array, "segment degree output"]
    length: Float[Array, ""]
    greens: tuple[Flexibility | SectionFlexibility, ...]
    factors: tuple[Float[Array, " _"], ...]
    outputs: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    count: int = eqx.field(static=True)
    mirrored: bool = eqx.field(static=True, default=False)

    def of_forces_at(
        self, x: Float[Array, "*position"], near: Float[Array, "*position"]
    ) -> Float[Array, "*position output"]:
        """Outputs per newton upwards at positions x (m), off the beam as at its nearer end.

        A force is on the side of each place on which `near` (m) is; at the place, its limit there.
        """
        step = max(2 * SIDE_SHARE, 8 * float(np.finfo(x.dtype).eps)) * self.length
        passed = self.places <= near[..., None]
        lower = xp.max(xp.where(passed, self.places + step, 0.0), axis=-1)
        upper = xp.min(xp.where(passed, self.length, self.places), axis=-1)
        y = xp.clip(x, lower, xp.maximum(lower, upper)) / self.length
        parts = [
            factor * greens(y) for greens, factor in zip(self.greens, self.factors, strict=True)
        ]
        given = np.concatenate([np.array(index, int) for index in self.outputs])
        others = np.setdiff1d(np.arange(self.count), given)
        zeros = xp.zeros((*x.shape, others.size))
        as_given = np.argsort(np.concatenate([given, others]))
        influence = xp.concatenate([*parts, zeros], axis=-1)[..., as_given]
        of_modes = piecewise_chebyshev(self.nodes, self.series, y * self.length, (0,))[0]
        influence = influence - of_modes
        return xp.concatenate([influence, -influence], -1) if self.mirrored else influence


class StaticCorrection(Module):
    """Static correction of outputs: rows, and the influence of forces of the loads."""

    rows: CorrectionRows
    influence: LoadInfluence


def static_correction(
    model: ModalModel,
    case: Case,
    sensors: Sequence[Sensor],
    outputs: OutputRows,
    modal_sums: int = 0,
) -> StaticCorrection | None:
    """Static correction of the `outputs` of sensors, in the coordinates of their modal model.

    The last `modal_sums` of the sensors are left as sums of the modes. None where no sensor
    measures a curvature, strain or section force, and for beams that can move as a rigid body.
    """
    corrected = sensors[: len(sensors) - modal_sums]
    bending = [i for i, sensor in enumerate(corrected) if sensor.bends]
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
    outputs_of_groups = tuple(tuple(index) for index in groups.values())
    influence = LoadInfluence(
        xp.stack([sensors[i].position for i in bending]),
        model.modes.nodes,
        model.modes.series @ of_modes,
        length,
        tuple(all_greens),
        tuple(factors),
        outputs_of_groups,
        count,
    )
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
