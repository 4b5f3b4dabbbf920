"""One case to one record."""

import dataclasses
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.integrator.discrete_model import DiscreteModel, discrete_model
from jaxbeam.integrator.events import sample_schedule
from jaxbeam.integrator.input_policy import AbstractInputPolicy
from jaxbeam.integrator.integrate import integrate_history
from jaxbeam.integrator.propagators import NODE_COUNT, end_weights
from jaxbeam.integrator.running_peaks import Peaks
from jaxbeam.integrator.time_grid import grid_by_schedule
from jaxbeam.model.contact import LoadSet, contact_at, load_set
from jaxbeam.model.measurement import sensor_readings
from jaxbeam.model.modal_model import ModalModel, modal_model
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.closed_loop import closed_loop
from jaxbeam.simulation.integration_plan import (
    TOLERANCE,
    IntegrationPlan,
    integration_plan,
    sample_times,
)
from jaxbeam.simulation.record import Record


class ContactLossWarning(UserWarning):
    """A load would have to pull on the beam to stay on it, and in the model it does."""


def simulate(
    case: Case,
    times: Float[Array, " time"] | None = None,
    plan: IntegrationPlan | None = None,
    tolerance: float = TOLERANCE,
) -> Record:
    """Simulate a case: the beam at rest at t = 0, then crossed by the loads.

    q'' + D q' + K q = sum of shapes(x_a) r_a, with r_a the contact forces (see `dynamics`),
    integrated to `tolerance` (relative to the largest deflection) by exponential collocation.
    Samples are at the run's own rate or at the given ascending `times` (s); they do not depend on
    the time step. Differentiable in every number of the case, forward and in reverse. Inside
    `jit` or `vmap`, give the `plan` made outside by `jaxbeam.simulation.integration_plan.integration_plan`.

    Raises ValueError for a faulty case or times, RuntimeError if no time step meets the
    tolerance; warns (ContactLossWarning) if a load would have to pull on the beam.
    """
    if times is not None:
        _check_times(times)
    if plan is None:
        plan = integration_plan(case, times, tolerance)
    times = sample_times(case) if times is None else jnp.asarray(times, float)
    # Plans that differ in their error alone share what is compiled.
    record = _simulate_record(
        case, dataclasses.replace(plan, error=0.0), times, jnp.asarray(plan.error)
    )
    if is_concrete(record.contact_lost_time):
        lost = np.isfinite(concrete(record.contact_lost_time))
        if lost.any() and np.isnan(concrete(record.diverged_time)):
            warnings.warn(record.verdict, ContactLossWarning, stacklevel=2)
    return record


def _check_times(times) -> None:
    if not is_concrete(times):
        return
    times = concrete(times)
    if times.ndim != 1 or times.size < 2:
        raise ValueError(
            f"times must be a list of at least two numbers, not of shape {times.shape}"
        )
    if not np.all(np.isfinite(times)) or not np.all(np.diff(times) > 0):
        raise ValueError("times must be finite and ascend, in s from the start of the run")


@compiled
def _simulate_record(case: Case, plan: IntegrationPlan, times, error) -> Record:
    running_peaks, outputs, modal, steps = _integrate(case, plan, times, case.sensor_positions)
    coordinates, rates, accelerations, position, force, commands, readings, failures = outputs
    if commands is None:
        commands = jnp.zeros((times.shape[0], len(case.actuators)))
    if failures is None:
        failures = jnp.zeros(times.shape)
    peaks = Peaks(*(part[0] for part in running_peaks.peaks()))
    loads, lost_times = load_set(case), peaks.contact_lost_time
    lost_positions = jnp.array(
        [
            path.kinematics(time)[0]
            for path, time in zip(loads.trajectories, lost_times, strict=True)
        ]
    ).reshape(-1)
    return Record(
        case=case,
        modes=modal,
        times=times,
        coordinates=coordinates,
        rates=rates,
        accelerations=accelerations,
        load_position=position,
        contact_force=force,
        command=commands,
        failures=failures,
        controller_readings=readings,
        **peaks._asdict(),
        contact_lost_position=lost_positions,
        error_estimate=error,
        steps=steps,
    )


def simulate_readings(
    case: Case, times: Float[Array, " time"], plan: IntegrationPlan
) -> Float[Array, "time sensor"]:
    """What the sensors read at ascending times (s), and nothing else: `Record.measured`.

    Without noise, which is not known of a log, neither in the readings nor in what a controller
    sees of them. Lean in compiling and differentiating, for fits; see `simulate`, which checks and
    warns.
    """
    _, outputs, modal, _ = _integrate(case, plan, times, None, noisy=False)
    coordinates, rates, accelerations, *_, controller_readings, _ = outputs
    if controller_readings is not None:
        return controller_readings
    return sensor_readings(case, modal, coordinates, rates, accelerations, times)


class Histories(NamedTuple):
    """Deflection (m) at some places, commands, and contact forces (N) of a run, at sample times."""

    deflection: Float[Array, "time place"]
    command: Float[Array, "time actuator"]
    contact_force: Float[Array, "time load"]


def simulate_histories(
    case: Case,
    times: Float[Array, " time"],
    plan: IntegrationPlan,
    positions: Float[Array, " place"],
) -> Histories:
    """Histories at ascending times (s) and places (m), and nothing else; as `simulate_readings`, lean."""
    _, outputs, modal, _ = _integrate(case, plan, times, None)
    coordinates, _, _, _, forces, commands, *_ = outputs
    if commands is None:
        commands = jnp.zeros((times.shape[0], len(case.actuators)))
    return Histories(coordinates @ modal.shapes(positions).T, commands, forces)


class IntegrationSetup(NamedTuple):
    """All that an integration needs: a rig on its grid, its loads, and what drives it, if any.

    `sample_steps` are the steps with which the samples begin, `steps` is how many steps there are.
    """

    model: DiscreteModel
    loads: LoadSet
    policy: AbstractInputPolicy | None
    sample_steps: Int[Array, " time"]
    steps: int


def integration_setup(
    case: Case, plan: IntegrationPlan, times, positions, noisy: bool = True
) -> IntegrationSetup:
    """A case made ready to be integrated as planned, watching deflections at some places (m)."""
    loads, layout = load_set(case), plan.shapes.layout
    if case.controller is None:
        model, policy = modal_model(case, layout, plan.shapes.coupled), None
        # From rest at the start to the first sample in steps like those between samples.
        spacing = (times[-1] - times[0]) / (times.shape[0] - 1)
        lead_times = times[0] - spacing * jnp.arange(plan.lead_samples, 0, -1)
        schedule = sample_schedule(
            jnp.concatenate([lead_times, times]), plan.equally_spaced, plan.lead_samples
        )
    else:
        schedule = plan.schedule
        policy = closed_loop(case, layout, loads, schedule, noisy)
        model = policy.model
    grid = grid_by_schedule(case, model, schedule, plan.substeps)
    discrete = discrete_model(model, grid, positions, policy)
    sample_steps = plan.substeps * grid.event_panels[schedule.sample_events]
    return IntegrationSetup(
        discrete, loads, policy, sample_steps, grid.counts.shape[0] * plan.substeps
    )


def _integrate(case: Case, plan: IntegrationPlan, times, positions, noisy=True):
    """Extremes, outputs at the sample times, modes, and the number of steps."""
    discrete, loads, policy, sample_steps, steps = integration_setup(
        case, plan, times, positions, noisy
    )
    model = discrete.model
    running_peaks, states, commands, observed, _ = integrate_history(
        discrete, loads, max_loads=plan.shapes.max_loads, steps=steps, policy=policy
    )
    states = states[sample_steps]
    observed, failures = (
        (None, None) if observed is None else (part[sample_steps, ..., 0] for part in observed)
    )
    if policy is not None:
        # A law at every instant is asked itself: its polynomials are less exact at their ends.
        commands = (
            policy.commands_at(states[..., 0], times)
            if policy.implicit
            else _commands_at_steps(case, commands, sample_steps)
        )
    *coordinates, commands = _modal_and_contact_outputs(model, loads, times, states, commands)
    if commands is not None:
        commands = commands[:, : len(case.actuators)]
    return running_peaks, (*coordinates, commands, observed, failures), model.modes, steps


def _commands_at_steps(case: Case, commands, steps):
    """Commands (time, actuator) with which the steps at some edges begin, as they took effect."""
    histories = commands[..., 0].reshape(commands.shape[0], NODE_COUNT, -1)
    commands_at_start = jnp.tensordot(histories, end_weights()[:, 0], axes=[1, 0])[steps]
    limits = [actuator.command_limits() for actuator in case.actuators]
    low = jnp.array([-jnp.inf if pair is None else pair[0] for pair in limits])
    high = jnp.array([jnp.inf if pair is None else pair[1] for pair in limits])
    return jnp.clip(commands_at_start, low, high)


def _modal_and_contact_outputs(model: ModalModel, loads: LoadSet, times, states, commands):
    """Modal coordinates, rates and accelerations, loads' places and contact forces, commands."""

    def outputs_at(time, state, command):
        column = None if command is None else command[:, None]
        force, pushed = contact_at(model, loads, time, state, column)
        return force[:, 0], pushed[:, 0]

    force, accelerations = jax.vmap(outputs_at)(times, states, commands)
    states_count = 2 * accelerations.shape[1]
    coordinates = (states[:, 0:states_count:2, 0], states[:, 1:states_count:2, 0], accelerations)
    if model.mode_map is not None:
        coordinates = tuple(part @ model.mode_map.T for part in coordinates)
    position = loads.kinematics(times)[0].T
    return *coordinates, jnp.where(loads.on_beam(times).T, position, jnp.nan), -force, commands
