"""Simulation of one case: a record, or only readings or histories for fits."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case, check_is_case, concrete_case
from jaxbeam.case.contact import ONE_RUN
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import all_concrete, concrete, is_concrete
from jaxbeam.case.sensors import Sensor
from jaxbeam.case.validation import check_case
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel, modal_model
from jaxbeam.model.output_rows import (
    corrected_places,
    sensor_history,
    sensor_rows,
    static_correction,
)
from jaxbeam.model.plausibility.check import warn_if_implausible
from jaxbeam.model.sensor_signals import (
    VehicleMotion,
    relative_to_beam,
    sensor_readings,
    vehicle_readings,
)
from jaxbeam.model.static_correction import Motion
from jaxbeam.runtime.arrays import Array, any_jax, put, without_derivative, xp
from jaxbeam.runtime.compiling import compiled, compiled_if_traced
from jaxbeam.simulation.closed_loop import (
    closed_loop,
    loop_of_case,
    loop_schedule,
    moved_schedule,
    moves_events,
    with_fixed_events,
    with_fixed_losses,
)
from jaxbeam.simulation.commands import acting_ranges
from jaxbeam.simulation.errors import (
    absorber_peaks,
    monitored_sensors,
    peak_errors,
    sensor_extremes,
)
from jaxbeam.simulation.integration_plan import (
    TOLERANCE,
    IntegrationPlan,
    beam_and_vehicles,
    check_plan,
    check_times,
    integration_plan,
    run_schedule,
    runs_compiled,
    sample_count,
    sample_times,
    times_of_samples,
)
from jaxbeam.simulation.integrator.discrete_model import (
    NODE_COUNT,
    PEAK_NODES,
    DiscreteModel,
    discrete_model,
    end_weights,
    signed_both_ways,
)
from jaxbeam.simulation.integrator.inputs import AbstractInputPolicy
from jaxbeam.simulation.integrator.integrate import integrate_history, peaks_of_halves
from jaxbeam.simulation.integrator.peaks import Peaks, RunningPeaks
from jaxbeam.simulation.integrator.time_grid import TimeGrid, event_places, grid_by_schedule
from jaxbeam.simulation.record import Record, Result
from jaxbeam.simulation.section_forces import motion_at
from jaxbeam.simulation.varied_plan import traced_ranges, varied_plan, within
from jaxbeam.simulation.views import Flights

MAX_SHORTENINGS = 3  # of steps whose peaks are not exact enough
LARGEST_SHORTENING = 4.0  # largest factor of one of them
SINGLE_PRECISION = (
    "JAX computes in single precision, in which a run is less exact than its record says: call"
    ' jax.config.update("jax_enable_x64", True) first, and leave JAX_ENABLE_X64 unset'
)
NO_DERIVATIVE = (
    "{} of a record has no derivative, as it tells errors of steps that jump with the numbers of a"
    " case: leave it out of what is differentiated, or compare several values"
)


class ContactLossWarning(UserWarning):
    """Warning of a negative contact force, at which the load would lift off the beam."""


@checks_classes
def simulate(
    case: Case,
    times: Float[Array, " time"] | None = None,
    plan: IntegrationPlan | None = None,
    tolerance: float = TOLERANCE,
) -> Record:
    """Simulate a case: the beam, at rest at t = 0, under the moving loads.

    Integrates q'' + D q' + K q = sum of shapes(x_a) r_a, with r_a the contact forces (see
    `jaxbeam.model.contact`), to `tolerance` (relative to the largest deflection) by exponential
    collocation. Samples are at the sample rate of the run, which ends at its duration, or at
    ascending `times` (s), with the last of which it then ends. Samples do not depend on the time
    step, peaks not on the sample rate. Differentiable in every number of the case, forward and in
    reverse. Inside `jit`, `vmap` and other transformations steps are chosen from the values that
    `vmap` and `grad` have; under `jit` for masses up to that of the beam, forces, and speeds up to
    four times the slowest that crosses. For other traced numbers prepare a `jaxbeam.Simulator`,
    with their ranges. `record.result` then tells what is wrong with a run. A
    `plan` is for the times and the parts of one case, and for other numbers near those of it; the
    error that it states is for its own.

    Raises ValueError for an invalid case or times, for a plan of another case, and for traced
    numbers where JAX computes in single precision, RuntimeError if no time step meets the
    tolerance; warns (ContactLossWarning) of negative contact forces, and, unless a `plan` is given,
    of what looks wrong, such as units (PlausibilityWarning).

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> record = jb.simulate(case)
    >>> print(f"{1e3 * record.peak_deflection[0]:.2f} mm")
    2.00 mm
    """
    check_is_case(case)
    if times is not None:
        check_times(times)
    sampling = case.run.duration, case.run.sample_rate
    if not all_concrete(sampling if times is None else () if plan else times):
        raise ValueError(
            "times, or run.duration and run.sample_rate without them, must be concrete numbers, not"
            " traced by jax.jit or vmap: they fix the number of samples"
        )
    inside = np.ones((), bool)
    if case.lifts:
        return _simulate_lifting(case, times, plan, tolerance)
    if plan is not None:
        if tolerance != TOLERANCE and plan.error > tolerance:
            raise ValueError(
                f"the plan has an error of {plan.error:.1e}, more than the tolerance of"
                f" {tolerance:g}: give one of them only"
            )
        samples = sample_times(case) if times is None else times
        plan = check_plan(case, plan, xp.asarray(samples, float))
    elif all_concrete(case):
        warn_if_implausible(case if times is None else _until(case, times))
        record, plan = _concrete_run(case, times, tolerance)
        if record is not None and not any_jax(case, times):
            return _with_warning(record)
    else:
        middle, ranges = traced_ranges(case)
        plan = varied_plan(middle, ranges, times, tolerance, plan_of_peaks)
        inside = within(case, ranges)
    return simulate_planned(case, plan, times, tolerance, inside)


def _simulate_lifting(case: Case, times, plan: IntegrationPlan | None, tolerance: float) -> Record:
    """Record of a run with unilateral contact, in steps halved until two runs agree.

    Raises ValueError for a run that is traced or has a `plan`, RuntimeError if no runs agree.
    """
    from jaxbeam.simulation import unilateral as lifting  # late: few runs need it

    if plan is not None or any_jax(case, times):
        raise ValueError(ONE_RUN)
    check_case(case)
    warn_if_implausible(case if times is None else _until(case, times))
    held = dataclasses.replace(case, contact=None)
    plan = integration_plan(held, times, tolerance)
    samples = np.asarray(sample_times(held) if times is None else times, float)
    plan, coarse = lifting.with_short_steps(case, plan, samples), None
    for _ in range(lifting.MAX_HALVINGS):
        fine = _lifting_run(case, held, plan, samples)
        if coarse is not None:
            motions = coarse.outputs.motion, fine.outputs.motion
            errors = lifting.change_of_runs(held, fine.model, *motions)
            if errors[0] <= tolerance:
                return _with_result(_record(case, fine, samples), errors, tolerance, np.True_)
        coarse, plan = fine, dataclasses.replace(plan, substeps=2 * plan.substeps)
    raise RuntimeError(lifting.NO_LANDING.format(tolerance))


def _lifting_run(case: Case, held: Case, plan: IntegrationPlan, times) -> "Integration":
    """Unilateral run of a case by a plan for `held`, the case with bilateral contact."""
    from jaxbeam.simulation.unilateral import motion_at_samples, peaks_of_run, run_unilateral

    monitored = monitored_sensors(case)
    setup = integration_setup(held, plan, times, monitored)
    model, loads, grid = setup.model.model, setup.loads, setup.model.grid
    events = np.asarray(loads.events(event_places(model, None))[1])
    run = run_unilateral(case, model, loads, grid, events)
    motion = motion_at_samples(held, model, loads, run, times, setup.sample_steps)
    peaks = peaks_of_run(held, model, loads, run, monitored)
    outputs, none, steps = Outputs(*motion, None, None), np.zeros(0), len(run.pieces)
    parts = peaks, None, outputs, model, grid, none, none, None, steps
    return Integration(*parts, flights=run.flights)


def simulate_planned(case: Case, plan: IntegrationPlan, times, tolerance: float, inside) -> Record:
    """Record of a run by a plan, with the error of the plan added to its own.

    `inside` says whether the numbers of the case are within the ranges of the plan.
    """
    numbers = case, times
    # Default times by their number: a compiled run computes them from two numbers of the case.
    times = sample_count(case) if times is None else xp.asarray(times, float)
    record = _run(case, plan, times, tolerance, inside)
    estimates = ("error_estimate", "step_errors")
    refused = {
        name: without_derivative(getattr(record, name), numbers, NO_DERIVATIVE.format(name))
        for name in estimates
    }
    return _with_warning(dataclasses.replace(record, **refused))


def plan_of_peaks(case: Case, times, tolerance: float) -> IntegrationPlan:
    """Plan of a run of concrete numbers, with the errors of its peaks."""
    return _concrete_run(case, times, tolerance)[1]


def _concrete_run(case: Case, times, tolerance: float) -> tuple[Record | None, IntegrationPlan]:
    """Record of the concrete numbers of a case, under `grad` too, and the plan with exact peaks.

    No record (None) where a run that is compiled is differentiated: it would take another program.
    """
    if not isinstance(case.controller, AbstractController | None):
        check_case(case)  # which the first run does, too
    moving = case.controller is not None and moves_events(case, times)
    traced, case = any_jax(case, times), concrete_case(case)
    times = None if times is None else concrete(times)
    first, record = _FirstRun(case, times), None
    plan = integration_plan(case, times, tolerance, first)
    end = float(case.run.duration) if times is None else None
    times = sample_times(case) if times is None else times
    if not (traced and plan.schedule is not None and runs_compiled(plan.schedule)):
        record, plan = _refined(case, plan, times, tolerance, first)
    if moving:
        plan = dataclasses.replace(plan, schedule=loop_schedule(case, times, end, True))
    return record, plan


def _refined(
    case: Case, plan: IntegrationPlan, times, tolerance: float, first: "_FirstRun"
) -> tuple[Record, IntegrationPlan]:
    """Record of concrete numbers, with steps shortened until its peaks meet the tolerance.

    The plan that is returned has these steps, and the errors of the record.
    """
    inside = np.True_
    if first.record is None or first.substeps != plan.substeps:
        record = _run(case, plan, times, tolerance, inside, first.policy)
    else:
        record = _with_result(first.record, _errors_of(case, plan), tolerance, inside)
    for _ in range(MAX_SHORTENINGS):
        shorter = _substeps_for_peaks(record, plan, tolerance)
        if shorter == plan.substeps:
            break
        plan = dataclasses.replace(plan, substeps=shorter)
        record = _run(case, plan, times, tolerance, inside, first.policy)
    errors = {"error": float(record.error_estimate), "of_peaks": True}
    errors["sensor_errors"] = tuple(map(float, record.step_errors))
    return record, dataclasses.replace(plan, **errors)


def _errors_of(case: Case, plan: IntegrationPlan) -> Float[np.ndarray, " all"]:
    """Errors that a plan states: of the deflection, then of the quantity of each sensor."""
    return np.array([plan.error, *(plan.sensor_errors or (np.nan,) * len(case.sensors))])


def _with_result(record: Record, errors, tolerance: float, inside) -> Record:
    """The record with errors of the steps added, and with its `Result`."""
    # As arrays: of single numbers each value would have a program of its own.
    of_steps = record.error_estimate + errors[:1]
    lost = xp.isfinite(record.contact_lost_time) & ~record.loads.prescribed
    diverged = xp.any(xp.isnan(record.coordinates))
    flags = {
        Result.CONTACT_LOST: xp.any(lost) & (record.flights is None),
        Result.STEPS_TOO_LONG: ~xp.any(of_steps <= tolerance) & ~diverged,  # or NaN: none is known
        Result.DIVERGED: diverged,
        Result.OUT_OF_RANGE: xp.logical_not(inside),
    }
    return dataclasses.replace(
        record,
        error_estimate=of_steps.reshape(()),
        step_errors=record.step_errors + errors[1:],
        result=sum(int(flag) * xp.asarray(is_set, int) for flag, is_set in flags.items()),
    )


def _with_warning(record: Record) -> Record:
    """The same record, after a warning if loads lose contact and numbers are concrete."""
    if is_concrete(record.contact_lost_time):
        lost = np.isfinite(concrete(record.contact_lost_time)) & ~record.loads.prescribed
        if lost.any() and np.isnan(concrete(record.diverged_time)):
            warnings.warn(record.verdict, ContactLossWarning, stacklevel=3)
    return record


def _until(case: Case, times) -> Case:
    """The case with a run that ends with the last of some times (s)."""
    run = dataclasses.replace(case.run, duration=xp.asarray(times, float)[-1])
    return dataclasses.replace(case, run=run)


def _run(case: Case, plan: IntegrationPlan, times, tolerance: float, inside, policy=None) -> Record:
    """Record of a planned run; plans that differ only in their errors use one compiled program.

    The input `policy` is that of the case if it is None.
    """
    is_compiled = plan.schedule is not None and runs_compiled(plan.schedule)
    simulate_record = _simulate_compiled if is_compiled else _simulate
    if policy is None and not (plan.schedule is None or is_compiled or any_jax(case, times)):
        policy = loop_of_case(case, plan.shapes.layout, plan.schedule)
    errors = _errors_of(case, plan)
    plan = plan.without_statements()
    return simulate_record(case, plan, times, errors, tolerance, inside, policy)


def _substeps_for_peaks(record: Record, plan: IntegrationPlan, tolerance: float) -> int:
    """Steps between samples with which the peaks, which are interpolated, meet the tolerance."""
    excess = (float(record.error_estimate) - plan.error) / max(
        tolerance - plan.error, 0.1 * tolerance
    )
    if not excess > 1:  # or the run diverges
        return plan.substeps
    factor = min((2 * excess) ** (1 / len(PEAK_NODES)), LARGEST_SHORTENING)
    # Steps that begin elsewhere might have a larger error than the plan states.
    return int(np.ceil(factor)) * plan.substeps


class _FirstRun:
    """First trial run of a plan, which keeps its input policy, record and number of steps.

    It is the run of the result too, wherever the longest steps suffice.
    """

    def __init__(self, case: Case, times):
        self.case, self.times = case, times
        self.record, self.substeps, self.policy = None, 0, None

    def __call__(self, plan: IntegrationPlan, policy) -> tuple[Array, Array]:
        samples = sample_times(self.case) if self.times is None else xp.asarray(self.times, float)
        self.record, states, commands = _simulate_first(self.case, plan, samples, policy)
        self.substeps, self.policy = plan.substeps, policy
        return states, commands


@compiled_if_traced
def _simulate_first(case: Case, plan: IntegrationPlan, times, policy):
    """Record of a run without its errors, and its states and commands at all events."""
    monitored = monitored_sensors(case)
    integration = run_integration(case, plan, times, monitored, policy=policy)
    event = integration.grid.event_at(np.arange(integration.steps))
    events = plan.schedule.times.shape[0]

    def at_events(part):
        none = xp.zeros((events, *part.shape[1:]))
        return put(none, xp.where(event < 0, events, event), part)

    record = _record(case, integration, times)
    states = beam_and_vehicles(case, plan.shapes, policy, at_events(integration.states[:-1]))
    return record, states, at_events(integration.commands)


def _simulate_record(
    case: Case, plan: IntegrationPlan, times, errors, tolerance: float, inside, policy=None
) -> Record:
    times = times_of_samples(case, times) if isinstance(times, int) else times
    monitored = monitored_sensors(case)
    integration = run_integration(case, plan, times, monitored, policy=policy)
    record = _record(case, integration, times)
    return _with_result(record, errors, tolerance, inside)


def _record(case: Case, integration: "Integration", times) -> Record:
    """Record of an integration, with the errors of its peaks only and without a `Result`."""
    outputs = integration.outputs
    peaks = Peaks(*(part[0] for part in integration.running_peaks.peaks()))
    heights = peaks.peak_deflection
    extremes, peaks = sensor_extremes(case.sensors, peaks)
    loads, lost_times = load_set(case), peaks.contact_lost_time
    if loads.absorbers:  # which hold on to the beam
        lost_times = xp.where(loads.fixed, xp.nan, lost_times)
        lowest = xp.where(loads.fixed, xp.nan, peaks.lowest_contact_force)
        peaks = peaks._replace(lowest_contact_force=lowest, contact_lost_time=lost_times)
    # Each wheel at its own time.
    lost_positions = xp.diagonal(loads.kinematics(lost_times)[0])
    diverged = xp.any(xp.isnan(outputs.motion.coordinates))  # errors are not defined
    of_peaks = np.zeros(()), np.zeros(len(case.sensors))
    if not integration.plan_of_peaks:
        both = integration.running_peaks, integration.of_halves
        of_peaks = peak_errors(case, integration.model, *both, heights, outputs.motion)
    return Record(
        case=case,
        modes=integration.model.modes,
        times=times,
        **_motion_fields(outputs),
        **outputs.vehicles._asdict(),
        failures=xp.zeros(times.shape) if outputs.failures is None else outputs.failures,
        controller_readings=outputs.readings,
        **peaks._asdict(),
        **extremes._asdict(),
        **absorber_peaks(case, heights),
        contact_lost_position=lost_positions,
        error_estimate=xp.where(diverged, xp.nan, of_peaks[0]),
        step_errors=xp.where(diverged, xp.nan, of_peaks[1]),
        steps=integration.steps,
        flights=integration.flights,
    )


def _motion_fields(outputs: "Outputs") -> dict:
    """Fields of a record that follow from its motion."""
    fields = outputs.motion._asdict()
    if outputs.sent is None:
        return fields
    return fields | {"command": outputs.sent, "acting_command": fields["command"]}


_simulate = compiled_if_traced(_simulate_record)
_simulate_compiled = compiled(_simulate_record)


def simulate_readings(
    case: Case, times: Float[Array, " time"], plan: IntegrationPlan
) -> Float[Array, "time sensor"]:
    """Readings of all sensors at ascending times (s), as `Record.measured` but without noise.

    Those on vehicles follow those on the beam. The controller has no noise either, as that of a log
    is unknown. For fits: less to compile and differentiate than `simulate`, without its checks and
    warnings.
    """
    plan = check_plan(case, plan, times).without_statements()
    # Fits differentiate by all parameters at once. The matrices of all steps together would take
    # that many times their memory (5 GB of a log of 1400 samples, 12 modes, 7 parameters), and
    # seven times as long, most of it to get this memory.
    integration = run_integration(case, plan, times, None, noisy=False, in_chunks=True)
    outputs = integration.outputs
    readings = outputs.readings
    if readings is None:
        readings = sensor_readings(case, integration.model.modes, outputs.motion, times)
    if not case.vehicle_sensors:
        return readings
    bodies, motion = outputs.vehicles, outputs.motion
    heights = bodies.body_displacement, motion.coordinates
    stroke = relative_to_beam(case, integration.model.modes, *heights)
    return xp.concatenate([readings, vehicle_readings(case, bodies, stroke, times)], axis=1)


class Histories(NamedTuple):
    """Deflection (m) at given positions, commands and contact forces (N) of a run.

    Forces of wheels off the beam are zero, also those of vehicles on the ground. `measured` are
    true quantities of sensors, by name.
    """

    deflection: Float[Array, "time position"]
    command: Float[Array, "time actuator"]
    contact_force: Float[Array, "time load"]
    measured: dict[str, Float[Array, "time _"]]


def simulate_histories(
    case: Case,
    times: Float[Array, " time"],
    plan: IntegrationPlan,
    positions: Float[Array, " position"],
    quantities: Sequence[str] = (),
) -> Histories:
    """Histories at ascending times (s) and positions (m), and of the sensors of some quantities.

    See `simulate_readings`.
    """
    plan = check_plan(case, plan, times).without_statements()
    integration = run_integration(case, plan, times, None)
    motion, modal = integration.outputs.motion, integration.model.modes
    deflection = motion.coordinates @ modal.shapes(positions).T
    on_beam = xp.isfinite(motion.load_position)
    contact_force = xp.where(on_beam, motion.contact_force, 0.0)
    measured = {
        name: xp.stack([sensor_history(case, modal, motion, sensor) for sensor in own], axis=1)
        for name in quantities
        if (own := [sensor for sensor in case.sensors if sensor.quantity == name])
    }
    sent = integration.outputs.sent
    command = motion.command if sent is None else sent
    return Histories(deflection, command, contact_force, measured)


class IntegrationSetup(NamedTuple):
    """Inputs of one integration: discrete model, loads, input policy (None without controller).

    `sample_steps` are the indices of the steps that start at the samples, `steps` is the number of
    steps; `on_grid` returns the discrete model on another grid.
    """

    model: DiscreteModel
    loads: LoadSet
    policy: AbstractInputPolicy | None
    sample_steps: Int[Array, " time"]
    steps: int
    on_grid: Callable[[TimeGrid], DiscreteModel]


def integration_setup(
    case: Case,
    plan: IntegrationPlan,
    times,
    monitored: Sequence[Sensor] | None,
    noisy: bool = True,
    policy: AbstractInputPolicy | None = None,
) -> IntegrationSetup:
    """Setup of a planned integration; without noise unless `noisy`.

    The input `policy` is that of the case if left out. Peaks are those of what the `monitored`
    sensors measure, upwards, then downwards; the last are at the absorbers (`monitored_sensors`).

    Raises ValueError for traced numbers in single precision.
    """
    if any_jax(case, times) and not jax.config.jax_enable_x64:
        raise ValueError(SINGLE_PRECISION)
    layout = plan.shapes.layout
    loads = load_set(case, layout)
    if case.controller is None:
        model, policy = modal_model(case, layout, plan.shapes.coupled), None
        choices = plan.equally_spaced, plan.lead_samples, plan.to_duration
        schedule = run_schedule(case, times, *choices)
    else:
        schedule = plan.schedule
        case = with_fixed_losses(case)
        if schedule.source is None:
            case, times = with_fixed_events(case, times)
        else:
            schedule = moved_schedule(case, schedule, times, plan.to_duration)
        policy = policy or closed_loop(case, layout, loads, schedule, noisy)
        model = policy.model
    places = None if monitored is None else corrected_places(case, model, monitored)
    grid = grid_by_schedule(case, model, schedule, plan.substeps, places, loads=loads)
    outputs = None if monitored is None else sensor_rows(model, case, monitored)
    correction = outputs and static_correction(model, case, monitored, outputs)

    def on_grid(grid):
        discrete = discrete_model(model, grid, None, policy, outputs, correction)
        discrete = dataclasses.replace(discrete, absorbers=len(case.absorbers))
        return discrete if outputs is None else signed_both_ways(discrete)

    sample_steps = plan.substeps * grid.event_panels[schedule.sample_events]
    steps = grid.counts.shape[0] * plan.substeps
    return IntegrationSetup(on_grid(grid), loads, policy, sample_steps, steps, on_grid)


class Integration(NamedTuple):
    """Result of one integration: running peaks, outputs at the sample times, states, commands.

    `states` (boundary, state, batch) are at the boundaries of the steps, `sampled_states` (time,
    state) at the sample times, `commands` (step, command, batch) at the nodes of each step.
    `of_halves` are the `peaks_of_halves` of a run of concrete numbers; none are needed where the
    errors of the plan hold those of peaks.
    """

    running_peaks: Any
    of_halves: RunningPeaks | None
    outputs: "Outputs"
    model: ModalModel
    grid: TimeGrid
    states: Array
    sampled_states: Array
    commands: Array | None
    steps: int
    plan_of_peaks: bool = False
    flights: Flights | None = None


def run_integration(
    case: Case,
    plan: IntegrationPlan,
    times,
    monitored,
    noisy=True,
    policy=None,
    in_chunks: bool = False,
):
    """Integrate a case as planned, under its own input policy unless one is given.

    A traced case may be integrated `in_chunks` of a few steps, whose matrices are assembled chunk
    by chunk.
    """
    discrete, loads, policy, sample_steps, steps, on_grid = integration_setup(
        case, plan, times, monitored, noisy, policy
    )
    model, max_loads = discrete.model, plan.shapes.max_loads
    running_peaks, all_states, node_commands, observed, _ = integrate_history(
        discrete, loads, max_loads=max_loads, steps=steps, policy=policy, in_chunks=in_chunks
    )
    of_halves, in_steps = None, (running_peaks, all_states, node_commands)
    if monitored and not (plan.of_peaks or any_jax(discrete, loads, in_steps)):
        of_halves = peaks_of_halves(on_grid, discrete.grid, loads, max_loads, *in_steps)
    states = all_states[sample_steps]

    def at_samples(part):
        return None if part is None else part[sample_steps, ..., 0]

    commands = None
    readings, failures, sent = (None,) * 3 if observed is None else tuple(map(at_samples, observed))
    if policy is not None:
        # In continuous time from the law itself: extrapolation from the Gauss nodes is less exact.
        commands = (
            policy.commands_at(states[..., 0], times)
            if policy.implicit and case.controller.period is None
            else _commands_at_steps(case, node_commands, sample_steps)
        )
    motion, vehicles = motion_at(case, model, loads, times, states, commands)
    outputs = Outputs(motion, vehicles, readings, failures, sent)
    return Integration(
        running_peaks,
        of_halves,
        outputs,
        model,
        discrete.grid,
        all_states,
        states[..., 0],
        node_commands,
        steps,
        plan.of_peaks,
    )


def _commands_at_steps(case: Case, commands, steps):
    """Commands (time, actuator) at the starts of steps, by extrapolation from their Gauss nodes."""
    histories = commands[..., 0].reshape(commands.shape[0], NODE_COUNT, -1)
    commands_at_start = xp.tensordot(histories, end_weights()[:, 0], axes=[1, 0])[steps]
    low, high, _ = acting_ranges(case)
    own = len(case.actuators)
    bounded = xp.clip(commands_at_start[:, :own], low, high)
    return xp.concatenate([bounded, commands_at_start[:, own:]], axis=1)


class Outputs(NamedTuple):
    """Motion of beam and vehicles at the samples; readings and failures of a controller, if any.

    `sent` are the commands of the controller where they act through hysteresis or creep; the
    commands in the motion are those that act.
    """

    motion: Motion
    vehicles: VehicleMotion
    readings: Float[Array, "time sensor"] | None
    failures: Float[Array, " time"] | None
    sent: Float[Array, "time actuator"] | None = None
