"""What the commands of a case can do to its beam, as numbers: a linear map.

While loads cross it the rig varies in time, but it stays linear in its commands: with u_k the
command to an actuator during one hold,

    w(x, t) = free(x, t) + sum_k response_k(x, t) u_k.

Both are found with the integrator of `simulate`, one lane a unit command, all on the same path.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbeam.case.case import Case
from jaxbeam.integrator.events import Schedule, merged
from jaxbeam.integrator.input_policy import AbstractDriver
from jaxbeam.integrator.integrate import trace
from jaxbeam.integrator.propagators import NODES
from jaxbeam.integrator.step_matrices import make_rigging
from jaxbeam.integrator.time_grid import scheduled_grid
from jaxbeam.model.contact import Traffic, traffic
from jaxbeam.model.modal_model import rig
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.integration_plan import Form, form, suitable_step

TOLERANCE = 1e-9  # relative to the largest deflection
LANES = 256  # at once; more fall out of the cache
MOST = 3e8  # numbers in a response: some gigabytes


class Reach(eqx.Module):
    """Motion without commands, and what a unit command during each hold adds to it.

    Commands are held from one of the `holds` (s) to the next. Motion is that at the `instants` (s)
    in coordinates of the rig, which `rows` take to the deflection (m) at some places; it is right
    to about 1e-9.
    """

    rows: Float[np.ndarray, "place mode"]
    holds: Float[np.ndarray, " hold"]
    instants: Float[np.ndarray, " instant"]
    free: Float[np.ndarray, "instant mode"]
    response: Float[np.ndarray, "instant mode hold actuator"]

    def deflection(
        self, commands: Float[np.ndarray, "hold actuator"]
    ) -> Float[np.ndarray, "instant place"]:
        """Deflection (m) under a history of commands."""
        return (self.free + np.tensordot(self.response, commands, axes=2)) @ self.rows.T


class _Units(AbstractDriver):
    """To each lane one unit command: to actuator `which`, during hold number `hold`."""

    schedule: Schedule
    hold: Int[Array, " lane"]
    which: Int[Array, " lane"]
    bound: Float[Array, " state"]
    actuators: int = eqx.field(static=True)
    inner: bool = eqx.field(static=True, default=False)

    def start(self, lanes):
        return jnp.zeros((), int)

    def drive(self, memory, state, moment, states):
        tick = self.schedule.tick[moment.edge]
        now = jnp.where((moment.edge >= 0) & (tick >= 0), tick, memory)
        own = self.which == np.arange(self.actuators)[:, None]
        given = jnp.where(own & (self.hold == now), 1.0, 0.0)
        return jnp.broadcast_to(given, (NODES, *given.shape)), now

    def shows(self, memory, moment):
        return None


def reach(case: Case, places: Float[np.ndarray, " place"], period: float, spacing: float) -> Reach:
    """Free motion of a case, and responses to commands held over a period (s), for some places (m).

    The controller of the case, if any, plays no part. Instants are at most `spacing` (s) apart;
    the starts of all holds and the end of the run are among them.

    Raises ValueError if there are too many holds and instants to keep, RuntimeError if no time
    step is exact enough.
    """
    duration = float(case.run.duration)
    count = max(1, int(np.ceil(duration / period * (1 - 1e-12))))
    each = max(1, int(np.ceil(period / spacing * (1 - 1e-9))))
    holds = np.arange(count) * period
    instants = np.append(np.arange(count * each) * (period / each), duration)
    instants = instants[(instants < duration * (1 - 1e-9)) | (instants == duration)]
    actuators = len(case.actuators)
    size = instants.size * case.beam.modes * count * actuators
    if size > MOST:
        raise ValueError(
            f"{count} holds and {instants.size} instants are too many to keep; hold commands for"
            f" longer than {period:g} s, or save samples more rarely (run.sample_rate)"
        )
    plain = eqx.tree_at(lambda c: c.controller, case, None, is_leaf=lambda leaf: leaf is None)
    shape = form(plain)
    step, _ = suitable_step(plain, shape, TOLERANCE)
    schedule = merged(instants, holds, 0.0, [], [], np.zeros(0))
    substeps = max(1, int(np.ceil(float(np.diff(instants).max()) / step)))
    # A lane that waits for hold -1 or for one after the end is given no command.
    hold = np.append(-1, np.repeat(np.arange(count), actuators))
    which = np.append(0, np.tile(np.arange(actuators), count))
    lanes = min(LANES, hold.size)
    idle = -hold.size % lanes
    hold, which = np.append(hold, np.full(idle, count)), np.append(which, np.zeros(idle, int))
    found = np.concatenate(
        [
            np.asarray(_answers(plain, shape, schedule, substeps, *some))
            for some in zip(hold.reshape(-1, lanes), which.reshape(-1, lanes), strict=True)
        ],
        axis=-1,
    )
    response = found[..., 1 : count * actuators + 1]
    return Reach(
        np.asarray(_rows(plain, shape, jnp.asarray(places))),
        holds,
        instants,
        found[..., 0],
        response.reshape(*response.shape[:2], count, actuators),
    )


@compiled
def _rows(case: Case, form: Form, places):
    return rig(case, form.layout).shapes(places, (0,))[0]


@compiled
def _answers(case: Case, form: Form, schedule: Schedule, substeps: int, hold, which):
    """Coordinates (instant, mode, lane) under the weights where `hold` is -1, else under a unit."""
    assembled, own = rig(case, form.layout), traffic(case)
    size = (len(own.motions), hold.shape[0])
    loads = Traffic(
        own.motions,
        jnp.broadcast_to(own.inertia, size),
        jnp.where(hold == -1, jnp.broadcast_to(own.weight, size), 0.0),
    )
    endless = jnp.full(assembled.states, jnp.inf)
    driver = _Units(
        schedule=schedule, hold=hold, which=which, bound=endless, actuators=len(case.actuators)
    )
    grid = scheduled_grid(case, assembled, schedule, substeps)
    steps = grid.counts.shape[0] * substeps
    rigging = make_rigging(assembled, grid, None, driver)
    _, states, *_ = trace(rigging, loads, slots=form.slots, steps=steps, driver=driver)
    edges = substeps * grid.place[schedule.samples]
    return states[edges][:, : 2 * case.beam.modes : 2]
