"""One case to one record."""

import dataclasses
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbeam.case.case import Case
from jaxbeam.case.fields import is_known, known
from jaxbeam.integrator.events import sampled
from jaxbeam.integrator.input_policy import AbstractInputPolicy
from jaxbeam.integrator.integrate import trace
from jaxbeam.integrator.propagators import NODES, at_ends
from jaxbeam.integrator.running_peaks import Found
from jaxbeam.integrator.step_matrices import Rigging, make_rigging
from jaxbeam.integrator.time_grid import scheduled_grid
from jaxbeam.model.contact import Traffic, at_instant, traffic
from jaxbeam.model.measurement import measure
from jaxbeam.model.modal_model import Rig, rig
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
    if is_known(record.contact_lost_time):
        lost = np.isfinite(known(record.contact_lost_time))
        if lost.any() and np.isnan(known(record.diverged_time)):
            warnings.warn(record.verdict, ContactLossWarning, stacklevel=2)
    return record


def _check_times(times) -> None:
    if not is_known(times):
        return
    times = known(times)
    if times.ndim != 1 or times.size < 2:
        raise ValueError(
            f"times must be a list of at least two numbers, not of shape {times.shape}"
        )
    if not np.all(np.isfinite(times)) or not np.all(np.diff(times) > 0):
        raise ValueError("times must be finite and ascend, in s from the start of the run")


@compiled
def _simulate_record(case: Case, plan: IntegrationPlan, times, error) -> Record:
    running_peaks, outputs, modal, steps = _integrate(case, plan, times, case.sensor_places)
    coordinates, rates, accelerations, position, force, commands, readings, failures = outputs
    if commands is None:
        commands = jnp.zeros((times.shape[0], len(case.actuators)))
    if failures is None:
        failures = jnp.zeros(times.shape)
    peaks = Found(*(part[0] for part in running_peaks.found()))
    loads, lost_times = traffic(case), peaks.contact_lost_time
    lost_positions = jnp.array(
        [path.travel(time)[0] for path, time in zip(loads.motions, lost_times, strict=True)]
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
    return measure(case, modal, coordinates, rates, accelerations, times)


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

    model: Rigging
    loads: Traffic
    policy: AbstractInputPolicy | None
    sample_steps: Int[Array, " time"]
    steps: int


def integration_setup(
    case: Case, plan: IntegrationPlan, times, positions, noisy: bool = True
) -> IntegrationSetup:
    """A case made ready to be integrated as planned, watching deflections at some places (m)."""
    loads, layout = traffic(case), plan.shapes.layout
    if case.controller is None:
        model, policy = rig(case, layout, plan.shapes.coupled), None
        # From rest at the start to the first sample in steps like those between samples.
        spacing = (times[-1] - times[0]) / (times.shape[0] - 1)
        lead_times = times[0] - spacing * jnp.arange(plan.lead_samples, 0, -1)
        schedule = sampled(
            jnp.concatenate([lead_times, times]), plan.equally_spaced, plan.lead_samples
        )
    else:
        schedule = plan.schedule
        policy = closed_loop(case, layout, loads, schedule)
        if not noisy:
            policy = dataclasses.replace(policy, noise=None)
        model = policy.model
    grid = scheduled_grid(case, model, schedule, plan.substeps)
    discrete = make_rigging(model, grid, positions, policy)
    sample_steps = plan.substeps * grid.place[schedule.samples]
    return IntegrationSetup(
        discrete, loads, policy, sample_steps, grid.counts.shape[0] * plan.substeps
    )


def _integrate(case: Case, plan: IntegrationPlan, times, positions, noisy=True):
    """Extremes, outputs at the sample times, modes, and the number of steps."""
    discrete, loads, policy, sample_steps, steps = integration_setup(
        case, plan, times, positions, noisy
    )
    model = discrete.rig
    running_peaks, states, commands, observed, _ = trace(
        discrete, loads, slots=plan.shapes.max_loads, steps=steps, driver=policy
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
    histories = commands[..., 0].reshape(commands.shape[0], NODES, -1)
    commands_at_start = jnp.tensordot(histories, at_ends()[:, 0], axes=[1, 0])[steps]
    limits = [actuator.command_limits() for actuator in case.actuators]
    low = jnp.array([-jnp.inf if pair is None else pair[0] for pair in limits])
    high = jnp.array([jnp.inf if pair is None else pair[1] for pair in limits])
    return jnp.clip(commands_at_start, low, high)


def _modal_and_contact_outputs(model: Rig, loads: Traffic, times, states, commands):
    """Modal coordinates, rates and accelerations, loads' places and contact forces, commands."""

    def outputs_at(time, state, command):
        column = None if command is None else command[:, None]
        force, pushed = at_instant(model, loads, time, state, column)
        return force[:, 0], pushed[:, 0]

    force, accelerations = jax.vmap(outputs_at)(times, states, commands)
    states_count = 2 * accelerations.shape[1]
    coordinates = (states[:, 0:states_count:2, 0], states[:, 1:states_count:2, 0], accelerations)
    if model.mixing is not None:
        coordinates = tuple(part @ model.mixing.T for part in coordinates)
    position = loads.travel(times)[0].T
    return *coordinates, jnp.where(loads.on_beam(times).T, position, jnp.nan), -force, commands
