"""Influence of the commands on the motion: an affine map of the held commands.

The beam under moving loads varies in time, but it is linear in its commands: with u_k the command
to one actuator during one hold,

    w(x, t) = w_0(x, t) + sum_k g_k(x, t) u_k.

Both parts come from the integrator of `simulate`, in batches of unit commands on one load path.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.case import Case
from jaxbeam.integrator.discrete_model import discrete_model
from jaxbeam.integrator.inputs import AbstractInputPolicy
from jaxbeam.integrator.integrate import integrate_history
from jaxbeam.integrator.propagators import NODE_COUNT
from jaxbeam.integrator.static_shapes import StaticShapes, static_shapes
from jaxbeam.integrator.step_size import choose_step_size
from jaxbeam.integrator.time_grid import (
    EventSchedule,
    Transmission,
    controller_schedule,
    grid_by_schedule,
)
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.runtime.arrays import Array, take, xp
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.runtime.memory import block_memory, free_memory, size_text
from jaxbeam.runtime.module import Module
from jaxbeam.simulation.integration_plan import steps_per_interval

TOLERANCE = 1e-9  # relative to the largest deflection
MAX_BATCH_SIZE = 1024  # unit commands at once; fewer where memory is short
COPIES = 3  # of the states of all steps of a run, while they are integrated


class InputInfluence(Module):
    """Modal coordinates at `times` (s): `unforced` by commands, and `response` to unit commands.

    A unit command is held from one of the `hold_times` (s) to the next. `deflection_rows` map the
    coordinates to the deflection (m) at given positions. Relative errors are about 1e-9.
    """

    deflection_rows: Float[np.ndarray, "position mode"]
    hold_times: Float[np.ndarray, " hold"]
    times: Float[np.ndarray, " time"]
    unforced: Float[np.ndarray, "time mode"]
    response: Float[np.ndarray, "time mode hold actuator"]

    def deflection(
        self, commands: Float[np.ndarray, "hold actuator"]
    ) -> Float[np.ndarray, "time position"]:
        """Deflection (m) under held commands."""
        return (
            self.unforced + np.tensordot(self.response, commands, axes=2)
        ) @ self.deflection_rows.T


class _UnitCommands(AbstractInputPolicy):
    """Input policy of unit commands: in each run to one actuator, during one hold."""

    schedule: EventSchedule
    hold_index: Int[Array, " batch"]
    actuator_index: Int[Array, " batch"]
    load_amplitude: float
    actuators: int = eqx.field(static=True)
    implicit: bool = eqx.field(static=True, default=False)

    def start(self, batch_size):
        return xp.zeros((), int)

    def inputs(self, memory, state, step_info, states):
        hold_started = take(self.schedule.control_sample, step_info.event)
        current_hold = xp.where((step_info.event >= 0) & (hold_started >= 0), hold_started, memory)
        is_commanded = self.actuator_index == np.arange(self.actuators)[:, None]
        command = xp.where(is_commanded & (self.hold_index == current_hold), 1.0, 0.0)
        return xp.broadcast_to(command, (NODE_COUNT, *command.shape)), current_hold

    def observe(self, memory, step_info):
        return None


def input_influence(
    case: Case, positions: Float[np.ndarray, " position"], period: float, spacing: float
) -> InputInfluence:
    """Influence of commands held over a period (s) on a case, with rows for positions (m).

    The controller of the case, if any, is left out. Times are at most `spacing` (s) apart; the
    starts of all holds and the end of the run are among them.

    Raises ValueError if the response takes more than half of the memory that is free, RuntimeError
    if no time step meets TOLERANCE.
    """
    duration = float(case.run.duration)
    count = max(1, int(np.ceil(duration / period * (1 - 1e-12))))
    steps_per_hold = max(1, int(np.ceil(period / spacing * (1 - 1e-9))))
    hold_times = np.arange(count) * period
    times = np.append(np.arange(count * steps_per_hold) * (period / steps_per_hold), duration)
    times = times[(times < duration * (1 - 1e-9)) | (times == duration)]
    actuators = len(case.actuators)
    size, memory = 8.0 * times.size * case.beam.modes * count * actuators, free_memory()
    if size > memory / 2:
        raise ValueError(
            f"responses to {count} holds at {times.size} times take {size_text(size)}, more than"
            f" half of the {size_text(memory)} of memory that are free; hold commands for longer"
            f" than {period:g} s, or lower run.sample_rate"
        )
    uncontrolled_case = dataclasses.replace(case, controller=None)
    shapes = static_shapes(uncontrolled_case)
    step, *_ = choose_step_size(uncontrolled_case, shapes, TOLERANCE)
    schedule = controller_schedule(times, Transmission(hold_times, hold_times), [], np.zeros(0))
    substeps = steps_per_interval(np.diff(times).max(), step)
    # Runs with hold -1 (the unforced one) or a hold after the end (padding) have no command; of
    # these the padding is disturbed by the profile alone, as all runs with a command are.
    hold_index = np.append([-1, count], np.repeat(np.arange(count), actuators))
    actuator_index = np.append([0, 0], np.tile(np.arange(actuators), count))
    run_bytes = 8.0 * COPIES * times.size * substeps * 2 * case.beam.modes
    allowed = max(1, int(block_memory() / run_bytes))
    batch_size = min(MAX_BATCH_SIZE, hold_index.size, allowed)
    padding = -hold_index.size % batch_size
    hold_index, actuator_index = (
        np.append(hold_index, np.full(padding, count)),
        np.append(actuator_index, np.zeros(padding, int)),
    )
    coordinates = np.concatenate(
        [
            _unit_responses(uncontrolled_case, shapes, schedule, substeps, *indices)
            for indices in zip(
                hold_index.reshape(-1, batch_size),
                actuator_index.reshape(-1, batch_size),
                strict=True,
            )
        ],
        axis=-1,
    )
    response = coordinates[..., 2 : count * actuators + 2]
    if load_set(case).profile is not None:
        response = response - coordinates[..., 1:2]
    return InputInfluence(
        _deflection_rows(uncontrolled_case, shapes, positions),
        hold_times,
        times,
        coordinates[..., 0],
        response.reshape(*response.shape[:2], count, actuators),
    )


@compiled_if_traced
def _deflection_rows(case: Case, shapes: StaticShapes, positions):
    return modal_model(case, shapes.layout).shapes(positions, (0,))[0]


@compiled_if_traced
def _unit_responses(
    case: Case,
    shapes: StaticShapes,
    schedule: EventSchedule,
    substeps: int,
    hold_index,
    actuator_index,
):
    """Modal coordinates (time, mode, batch): under weights for hold -1, else a unit command."""
    model, case_loads = modal_model(case, shapes.layout), load_set(case, shapes.layout)
    size = (case_loads.wheel_count, hold_index.shape[0])
    wheels = jax.tree.map(
        lambda part: xp.broadcast_to(part, (*part.shape[:-1], size[1])), case_loads.wheels
    )
    is_loaded = hold_index == -1
    histories = {
        wheel: dataclasses.replace(
            history,
            amplitudes=xp.where(is_loaded, history.amplitudes, 0.0),
            forces=xp.where(is_loaded, history.forces, 0.0),
        )
        for wheel, history in wheels.histories.items()
    }
    weight = xp.where(is_loaded, wheels.weight, 0.0)
    wheels = dataclasses.replace(wheels, weight=weight, histories=histories)
    loads = dataclasses.replace(case_loads, wheels=wheels)
    policy = _UnitCommands(
        schedule=schedule,
        hold_index=hold_index,
        actuator_index=actuator_index,
        load_amplitude=np.inf,
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
