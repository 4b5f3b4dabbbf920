"""The physics of contact: travelling loads on a vibrating beam.

A load of mass m at x(t) stays on the beam, so it is accelerated with the deflection under it,

    D2w/Dt2 = w_tt + 2 x' w_xt + x'^2 w_xx + x'' w_x,

and the force on the beam, positive upwards, is r = -W - m D2w/Dt2 with W its weight (corrected
eqs 2.3 to 2.13 of the thesis; a force has m = 0). In the states z of the rig, with f the forces
on the modes, D2w/Dt2 = (contact row) . z + (shape row) . f.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbeam.case.case import Case
from jaxbeam.case.loads import motion
from jaxbeam.case.trajectory import AbstractTrajectory
from jaxbeam.model.modal_model import Rig
from jaxbeam.numerics.batched_linalg import solve_small


class Traffic(eqx.Module):
    """All loads of a run: how they move, and how heavy they are.

    Inertia (kg) and weight (N) may differ between lanes: runs that share everything else.
    """

    motions: tuple[AbstractTrajectory, ...]
    inertia: Float[Array, "load lane"]
    weight: Float[Array, "load lane"]

    def travel(self, times: Float[Array, "*time"]) -> tuple[Float[Array, "load *time"], ...]:
        """Positions (m), speeds (m/s) and accelerations (m/s^2) at given times (s)."""
        if not self.motions:
            return (jnp.zeros((0, *times.shape)),) * 3
        paths = zip(*(path.travel(times) for path in self.motions), strict=True)
        position, speed, acceleration = (jnp.stack(parts) for parts in paths)
        return position, speed, acceleration

    def pieces(self) -> tuple[Float[Array, "load piece"], Float[Array, "load piece 4"]]:
        """The paths as cubic polynomials, as many for each load.

        Of loads as cases have them, see `motion.AbstractPieces`.
        """
        if not self.motions:
            return jnp.zeros((0, 1)), jnp.zeros((0, 1, 4))
        found = [path.pieces() for path in self.motions]
        most = max(times.shape[0] for times, _ in found)
        lacking = [(0, most - times.shape[0]) for times, _ in found]
        pairs = list(zip(found, lacking, strict=True))
        times = [jnp.pad(times, more, constant_values=np.inf) for (times, _), more in pairs]
        cubics = [jnp.pad(cubics, [more, (0, 0)]) for (_, cubics), more in pairs]
        return jnp.stack(times), jnp.stack(cubics)

    def on_beam(self, times: Float[Array, "*time"]) -> Bool[Array, "load *time"]:
        """Which loads are on the beam at given times (s): from entry until just before exit."""
        windows = [path.window() for path in self.motions]
        on = [(entry <= times) & (times < leave) for entry, leave in windows]
        return jnp.array(on, bool).reshape(len(on), *jnp.shape(times))


def traffic(case: Case) -> Traffic:
    """The loads of a case, as a single lane."""
    motions = tuple(motion(load, case.beam.length) for load in case.loads)
    gravity = case.run.gravity
    inertia = [load.inertia() for load in case.loads]
    weight = [load.weight(gravity) for load in case.loads]
    column = (len(motions), 1)
    return Traffic(motions, jnp.array(inertia).reshape(column), jnp.array(weight).reshape(column))


def contact_rows(rig: Rig, position, speed, acceleration, active):
    """Shape rows (*place, block, mode) and contact rows (*place, block, side) at the loads.

    Position (m), speed (m/s), acceleration (m/s^2) and whether it is on the beam, all (*place,);
    where it is not, the rows are zero.
    """
    inside = jnp.where(active, position, 0.0)
    shape, slope, curvature = jnp.where(active[..., None], rig.shapes(inside, (0, 1, 2)), 0.0)
    speed, acceleration = speed[..., None], acceleration[..., None]
    convected = speed**2 * curvature + acceleration * slope
    travelling = 2 * speed * slope
    blocks, each = rig.state_matrix.shape[0], rig.modes_per_block
    split = (*position.shape, blocks, each)
    shape = shape.reshape(split)
    rates = rig.state_matrix[:, 1 : 2 * each : 2, :]
    free = jnp.sum(shape[..., None] * rates, axis=-2) if each == 1 else shape @ rates
    added = jnp.stack([convected.reshape(split), travelling.reshape(split)], axis=-1)
    added = added.reshape(*split[:-1], 2 * each)
    rows = free.at[..., : 2 * each].add(added)
    return shape, rows


def at_instant(
    rig: Rig,
    traffic: Traffic,
    time: Float[Array, ""],
    state: Float[Array, "state lane"],
    command: Float[Array, "actuator lane"] | None = None,
) -> tuple[Float[Array, "load lane"], Float[Array, "mode lane"]]:
    """Contact forces r (N, upwards on the beam) and accelerations of q at an instant (s).

    At the time at which a load enters or leaves they are those just after.
    """
    position, speed, acceleration = traffic.travel(time)
    active = traffic.on_beam(time)
    shape, rows = contact_rows(rig, position, speed, acceleration, active)
    loads, modes = position.shape[0], rig.modes.stiffness.shape[0]
    shape, rows = shape.reshape(loads, modes), rows.reshape(loads, rig.states)
    blocks, side, _ = rig.state_matrix.shape
    drift = (rig.state_matrix @ state.reshape(blocks, side, -1)).reshape(state.shape)
    free = drift[1 : 2 * modes : 2]
    felt = rows @ state
    if command is not None:
        pushed = rig.command_matrix[1 : 2 * modes : 2] @ command
        free, felt = free + pushed, felt + shape @ pushed
    mass = jnp.where(active[:, None], traffic.inertia, 0.0)
    weight = jnp.where(active[:, None], traffic.weight, 0.0)
    # The contact law: (1 + m S S') r = -W - m (contact row) . z.
    matrix = jnp.eye(loads)[:, :, None] + mass[:, None] * (shape @ shape.T)[:, :, None]
    force = -solve_small(matrix, (weight + mass * felt)[:, None])[:, 0]
    return force, free + shape.T @ force


@jax.custom_jvp
def solve_contact(gains, inertia, drive):
    """Solve (1 + m_i G_ij) r_j = -d_i for every lane.

    `gains` (row, row) are shared, `inertia` and `drive` are (row, lane). The matrix is close to
    the identity plus a positive matrix for the step lengths in use.
    """
    matrix = inertia[:, None] * gains[:, :, None] + np.eye(gains.shape[0])[:, :, None]
    return solve_small(matrix, -drive[:, None])[:, 0]


@solve_contact.defjvp
def _solve_contact_jvp(primals, tangents):
    """The forces' change solves the same system: cheaper than differentiating the elimination."""
    gains, inertia, drive = primals
    gains_change, inertia_change, drive_change = tangents
    forces = solve_contact(*primals)
    change = inertia_change * (gains @ forces) + inertia * (gains_change @ forces) + drive_change
    return forces, solve_contact(gains, inertia, change)
