"""Contact forces at the ends of steps, for outputs that follow them at once.

Peaks of statically corrected outputs often are at an end, where an axle stands on a sensor. An
extrapolation of the forces at the Gauss nodes is the least accurate there; the states are the most
accurate, of order 12, and so are the forces that the contact law gives for them.
"""

import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.propagators import end_weights
from jaxbeam.model.contact import solve_at_instants, surface_rows
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.module import Module

END_FRACTIONS = (1e-9, 1.0 - 1e-9)  # of a step: limits within, where accelerations of loads jump


class EndRows(Module):
    """Wheels at the two ends of steps: mode shapes, rows of accelerations, and height rates.

    `accelerations` map states to the accelerations under the wheels, `surface` is the second rate
    of the profile's height there (m/s^2), None without a profile.
    """

    shapes: Float[Array, "step end load mode"]
    accelerations: Float[Array, "step end load state"]
    surface: Float[Array, "step end load"] | None


def end_rows(
    model: ModalModel, loads: LoadSet, start, length, load_index, on_beam
) -> EndRows | None:
    """Wheels at the ends of steps; None where no contact law is solved: forces, and vehicles."""
    if loads.massless or loads.wheels.vehicles:
        return None
    times = start[:, None] + length[:, None] * xp.asarray(END_FRACTIONS, length.dtype)
    index = load_index[:, None]
    position, speed, acceleration = (
        xp.take_along_axis(xp.moveaxis(part, 0, -1), index, axis=2)
        for part in loads.kinematics(times)
    )
    active = xp.broadcast_to(on_beam[:, None], position.shape)
    rows = surface_rows(model, position, speed, acceleration, active)
    surface = loads.surface_motion(position, speed, acceleration)
    return EndRows(
        rows.shape.reshape(*active.shape, -1),
        rows.acceleration.reshape(*active.shape, -1),
        None if surface is None else surface[2],
    )


def end_forces(
    rows: EndRows | None,
    inertia: Float[Array, "step row batch"],
    weight: Float[Array, "step load end batch"],
    before: Float[Array, "step state batch"],
    last: Float[Array, "state batch"],
    forces: Float[Array, "step row batch"],
) -> Float[Array, "step row_end batch"]:
    """Contact forces (N) of wheels at the ends of steps, from the states there.

    States are those `before` each step, and the `last` after all of them. Without `rows`
    forces are extrapolated from those at the Gauss nodes.
    """
    steps, count, batch = forces.shape
    nodes = end_weights().shape[0]
    by_load = (steps, count // nodes, nodes, batch)
    if rows is None:
        extrapolated = xp.einsum("tlfb,fe->tleb", forces.reshape(by_load), end_weights())
        return extrapolated.reshape(steps, -1, batch)
    mass = inertia.reshape(by_load)[:, None, :, 0]  # step, 1, load, batch
    acceleration = _at_ends(rows.accelerations, before, last)
    if rows.surface is not None:
        acceleration = acceleration + rows.surface[..., None]
    right = xp.swapaxes(weight, 1, 2) + mass * acceleration
    compliance = rows.shapes @ rows.shapes.mT
    matrix = np.eye(mass.shape[2])[..., None] + mass[:, :, :, None] * compliance[..., None]
    found = -solve_at_instants(matrix, right)
    return xp.swapaxes(found, 1, 2).reshape(steps, -1, batch)


def _at_ends(
    rows: Float[Array, "step end load state"],
    before: Float[Array, "step state batch"],
    last: Float[Array, "state batch"],
) -> Float[Array, "step end load batch"]:
    """Products of rows at the two ends of steps with the states there.

    Where a step ends the next one begins, so that both rows act on the states before the steps:
    these, by far the largest part, are read once and not copied.
    """
    at_end = rows[:, 1]
    of_former = xp.concatenate([xp.zeros_like(at_end[:1]), at_end[:-1]])
    starts, ends = xp.split(xp.concatenate([rows[:, 0], of_former], axis=1) @ before, 2, axis=1)
    ends = xp.concatenate([ends[1:], (at_end[-1] @ last)[None]])
    return xp.stack([starts, ends], axis=1)
