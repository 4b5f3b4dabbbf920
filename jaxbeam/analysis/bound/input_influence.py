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
from jaxbeam.integrator.events import EventSchedule, controller_schedule
from jaxbeam.integrator.input_policy import AbstractInputPolicy
from jaxbeam.integrator.integrate import integrate_history
from jaxbeam.integrator.propagators import NODE_COUNT
from jaxbeam.integrator.step_matrices import discrete_model
from jaxbeam.integrator.time_grid import grid_by_schedule
from jaxbeam.model.contact import LoadSet, load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.integration_plan import StaticShapes, choose_step_size, static_shapes

TOLERANCE = 1e-9  # relative to the largest deflection
MAX_BATCH_SIZE = 256  # at once; more fall out of the cache
MAX_RESPONSE_SIZE = 3e8  # numbers in a response: some gigabytes


class InputInfluence(eqx.Module):
    """Motion without commands, and what a unit command during each hold adds to it.

    Commands are held from one of the `hold_times` (s) to the next. Motion is that at the `times` (s)
    in coordinates of the rig, which `deflection_rows` take to the deflection (m) at some places; it is right
    to about 1e-9.
    """

    deflection_rows: Float[np.ndarray, "place mode"]
    hold_times: Float[np.ndarray, " hold"]
    times: Float[np.ndarray, " instant"]
    unforced: Float[np.ndarray, "instant mode"]
    response: Float[np.ndarray, "instant mode hold actuator"]

    def deflection(
        self, commands: Float[np.ndarray, "hold actuator"]
    ) -> Float[np.ndarray, "instant place"]:
        """Deflection (m) under a history of commands."""
        return (
            self.unforced + np.tensordot(self.response, commands, axes=2)
        ) @ self.deflection_rows.T


class _UnitCommands(AbstractInputPolicy):
    """To each lane one unit command: to actuator `actuator_index`, during hold number `hold_index`."""

    schedule: EventSchedule
    hold_index: Int[Array, " lane"]
    actuator_index: Int[Array, " lane"]
    state_bound: Float[Array, " state"]
    actuators: int = eqx.field(static=True)
    implicit: bool = eqx.field(static=True, default=False)

    def start(self, batch_size):
        return jnp.zeros((), int)

    def inputs(self, memory, state, step_info, states):
        hold_started = self.schedule.control_sample[step_info.event]
        current_hold = jnp.where((step_info.event >= 0) & (hold_started >= 0), hold_started, memory)
        is_commanded = self.actuator_index == np.arange(self.actuators)[:, None]
        given = jnp.where(is_commanded & (self.hold_index == current_hold), 1.0, 0.0)
        return jnp.broadcast_to(given, (NODE_COUNT, *given.shape)), current_hold

    def observe(self, memory, step_info):
        return None


def input_influence(
    case: Case, positions: Float[np.ndarray, " place"], period: float, spacing: float
) -> InputInfluence:
    """Free motion of a case, and responses to commands held over a period (s), for some places (m).

    The controller of the case, if any, plays no part. Instants are at most `spacing` (s) apart;
    the starts of all holds and the end of the run are among them.

    Raises ValueError if there are too many holds and instants to keep, RuntimeError if no time
    step is exact enough.
    """
    duration = float(case.run.duration)
    count = max(1, int(np.ceil(duration / period * (1 - 1e-12))))
    steps_per_hold = max(1, int(np.ceil(period / spacing * (1 - 1e-9))))
    hold_times = np.arange(count) * period
    times = np.append(np.arange(count * steps_per_hold) * (period / steps_per_hold), duration)
    times = times[(times < duration * (1 - 1e-9)) | (times == duration)]
    actuators = len(case.actuators)
    size = times.size * case.beam.modes * count * actuators
    if size > MAX_RESPONSE_SIZE:
        raise ValueError(
            f"{count} holds and {times.size} instants are too many to keep; hold commands for"
            f" longer than {period:g} s, or save samples more rarely (run.sample_rate)"
        )
    uncontrolled_case = eqx.tree_at(
        lambda c: c.controller, case, None, is_leaf=lambda leaf: leaf is None
    )
    shapes = static_shapes(uncontrolled_case)
    step, _ = choose_step_size(uncontrolled_case, shapes, TOLERANCE)
    schedule = controller_schedule(times, hold_times, 0.0, [], [], np.zeros(0))
    substeps = max(1, int(np.ceil(float(np.diff(times).max()) / step)))
    # A lane that waits for hold -1 or for one after the end is given no command.
    hold_index = np.append(-1, np.repeat(np.arange(count), actuators))
    actuator_index = np.append(0, np.tile(np.arange(actuators), count))
    batch_size = min(MAX_BATCH_SIZE, hold_index.size)
    padding = -hold_index.size % batch_size
    hold_index, actuator_index = (
        np.append(hold_index, np.full(padding, count)),
        np.append(actuator_index, np.zeros(padding, int)),
    )
    coordinates = np.concatenate(
        [
            np.asarray(_unit_responses(uncontrolled_case, shapes, schedule, substeps, *some))
            for some in zip(
                hold_index.reshape(-1, batch_size),
                actuator_index.reshape(-1, batch_size),
                strict=True,
            )
        ],
        axis=-1,
    )
    response = coordinates[..., 1 : count * actuators + 1]
    return InputInfluence(
        np.asarray(_deflection_rows(uncontrolled_case, shapes, jnp.asarray(positions))),
        hold_times,
        times,
        coordinates[..., 0],
        response.reshape(*response.shape[:2], count, actuators),
    )


@compiled
def _deflection_rows(case: Case, shapes: StaticShapes, positions):
    return modal_model(case, shapes.layout).shapes(positions, (0,))[0]


@compiled
def _unit_responses(
    case: Case,
    shapes: StaticShapes,
    schedule: EventSchedule,
    substeps: int,
    hold_index,
    actuator_index,
):
    """Coordinates (instant, mode, lane) under the weights where `hold_index` is -1, else under a unit."""
    model, weights_of_case = modal_model(case, shapes.layout), load_set(case)
    size = (len(weights_of_case.trajectories), hold_index.shape[0])
    loads = LoadSet(
        weights_of_case.trajectories,
        jnp.broadcast_to(weights_of_case.inertia, size),
        jnp.where(hold_index == -1, jnp.broadcast_to(weights_of_case.weight, size), 0.0),
    )
    state_bound = jnp.full(model.state_count, jnp.inf)
    policy = _UnitCommands(
        schedule=schedule,
        hold_index=hold_index,
        actuator_index=actuator_index,
        state_bound=state_bound,
        actuators=len(case.actuators),
    )
    grid = grid_by_schedule(case, model, schedule, substeps)
    steps = grid.counts.shape[0] * substeps
    discrete = discrete_model(model, grid, None, policy)
    _, states, *_ = integrate_history(
        discrete, loads, max_loads=shapes.max_loads, steps=steps, policy=policy
    )
    sample_steps = substeps * grid.event_panels[schedule.sample_events]
    return states[sample_steps][:, : 2 * case.beam.modes : 2]
