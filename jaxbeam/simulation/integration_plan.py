"""Integration plan: static shapes and number of steps of a run, and the case that it is for.

A plan fixes the number of loads on the beam, the steps between samples and the events of control.
It is computed from concrete numbers and is static in the compiled code, which then holds for all
numbers for which the plan is valid. Followed by another case it gives wrong numbers, so that what
is known of both is compared first.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.contact import ONE_RUN
from jaxbeam.case.fields import concrete, is_concrete, real_numbers
from jaxbeam.case.toml_file import MAX_SAMPLED, MAX_SAMPLES
from jaxbeam.case.validation import check_case
from jaxbeam.model.elements import largest_layout
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.runtime.arrays import Array, Module, any_jax, xp
from jaxbeam.runtime.compiling import compiled, compiled_if_traced
from jaxbeam.runtime.printer import counted
from jaxbeam.simulation.closed_loop import closed_loop, loop_of_case, loop_schedule, moves_events
from jaxbeam.simulation.errors import step_errors
from jaxbeam.simulation.integrator.discrete_model import discrete_model
from jaxbeam.simulation.integrator.inputs import AbstractInputPolicy, HeldCommands
from jaxbeam.simulation.integrator.integrate import integrate_at_events
from jaxbeam.simulation.integrator.step_size import (
    CONVERGENCE_ORDER,
    MAX_DIVERGED_HALVINGS,
    NO_STEP,
    UNSAMPLED,
    ErrorFloor,
    StaticShapes,
    StepTrial,
    check_step_count,
    check_tolerance,
    choose_step_size,
    largest_change,
    longest_trial_step,
    model_limits,
    rounding_deflection,
    static_shapes,
    steps_per_interval,
)
from jaxbeam.simulation.integrator.time_grid import EventSchedule, grid_by_schedule, sample_schedule

# Errors of a plan, relative to the largest deflection, beyond which it is not followed by a case of
# other numbers. They grow with the ninth power, at least, of steps over the stability limit.
LARGEST_ERROR = 1e-3
INSTEAD = "leave the plan out, or make it of this case and these times by integration_plan"


@dataclasses.dataclass(frozen=True, eq=False)
class PlanOrigin:
    """Case of a plan, with NaN for numbers that differ among several, its samples, its limit (s).

    `times` (s) are None where several cases differ in them.
    """

    case: Case
    times: Float[np.ndarray, " time"] | None
    max_stable_step: float


def common_origin(origins: Sequence[PlanOrigin | None]) -> PlanOrigin | None:
    """Origin of a plan for several cases, with NaN for numbers that differ; None without one."""
    first, *others = origins
    if first is None:
        return None
    case, times, limit = first.case, first.times, first.max_stable_step
    for other in others:
        if other is None or jax.tree.structure(other.case) != jax.tree.structure(case):
            return None
        case = jax.tree.map(_common_number, case, other.case)
        if times is None or other.times is None or not _same(times, other.times):
            times = None
        limit = min(limit, other.max_stable_step)
    return PlanOrigin(case, times, limit)


def check_origin(
    origin: PlanOrigin | None,
    shapes: StaticShapes,
    case: Case,
    times,
    steps_per_limit: float,
    error: float,
) -> bool:
    """Whether a plan is for exactly this case, as far as its numbers are concrete.

    `steps_per_limit` is the longest step of the plan over the stability limit of its origin,
    `error` that of the plan.
    Raises ValueError for a case that the plan does not hold for: other parts, supports or loads in
    another order, more loads on the beam at once, much faster motion, or other times. Traced
    numbers cannot be compared.
    """
    if origin is None:
        return True
    for key in (field.name for field in dataclasses.fields(case)):
        own, planned = getattr(case, key), getattr(origin.case, key)
        if key == "controller" and (own is None) == (planned is None):
            continue  # its events are compared, and another law has other errors only
        alike = jax.tree.structure(own) == jax.tree.structure(planned) and all(
            np.shape(a) == np.shape(b)
            for a, b in zip(jax.tree.leaves(own), jax.tree.leaves(planned), strict=True)
        )
        if not alike:
            raise ValueError(
                f"the plan was made for a case with other {key} (their number, kinds, names or"
                f" lists differ): {INSTEAD}"
            )
    if origin.times is not None and (
        np.shape(times) != origin.times.shape
        or (is_concrete(times) and not _same(concrete(times), origin.times))
    ):
        ours = concrete(times) if is_concrete(times) else np.zeros(0)
        raise ValueError(
            f"the plan was made for {_words(origin.times)}, and the run has"
            f" {_words(ours) if ours.size else 'others'}: {INSTEAD}"
        )
    leaves = jax.tree.leaves(case)
    if not all(map(is_concrete, leaves)):
        return True
    case = concrete_case(case)
    if jax.tree.structure(case) == jax.tree.structure(origin.case) and all(
        map(_same_or_nan, jax.tree.leaves(case), jax.tree.leaves(origin.case))
    ):
        return True
    own = static_shapes(case)
    if largest_layout((own.layout, shapes.layout)) != shapes.layout or own.coupled > shapes.coupled:
        raise ValueError(
            "the plan was made for a case with supports, actuators or sections in another order"
            f" along the beam, or without dampers between modes: {INSTEAD}"
        )
    if own.max_loads > shapes.max_loads:
        raise ValueError(
            f"the plan was made for at most {counted(shapes.max_loads, 'load')} on the beam"
            f" at once, and there are {own.max_loads}: {INSTEAD}"
        )
    ratio = origin.max_stable_step / float(model_limits(case, own.layout)[0])
    unstable = ratio * steps_per_limit > max(1.0, steps_per_limit) * (1 + 1e-9)
    if unstable or error * ratio**CONVERGENCE_ORDER > LARGEST_ERROR:
        raise ValueError(
            f"the steps of the plan are too long for this case, in which frequencies or speeds are"
            f" {ratio:.3g} times as high: {INSTEAD}"
        )
    return False


def check_same_events(planned: EventSchedule, own: EventSchedule) -> None:
    """Raises ValueError unless the control events of a run are those of its plan.

    Events of a moving plan may be at other times, in the same order.
    """
    moving = planned.source is not None
    if moving and len(own.times) == len(planned.times):
        times = {name: getattr(planned, name) for name in ("times", "lengths", "merging")}
        own = dataclasses.replace(own, **times)
    pairs = zip(jax.tree.leaves(planned), jax.tree.leaves(own), strict=False)
    if jax.tree.structure(planned) != jax.tree.structure(own) or not all(
        np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=1e-12, atol=1e-12) for a, b in pairs
    ):
        other = "in another order or number" if moving else "at other times"
        raise ValueError(
            f"the plan was made for control, readings or commands {other} (period, delays,"
            f" sampling periods): {INSTEAD}"
        )


def _common_number(a: Any, b: Any) -> Any:
    if np.shape(a) != np.shape(b):
        return np.full(np.shape(a), np.nan)
    return np.where(np.asarray(a) == np.asarray(b), a, np.nan)


def _same_or_nan(own: Any, planned: Any) -> bool:
    if np.shape(own) != np.shape(planned):
        return False
    return bool(np.all((np.asarray(own) == np.asarray(planned)) | np.isnan(planned)))


def _same(a: Float[np.ndarray, " time"], b: Float[np.ndarray, " time"]) -> bool:
    return a.shape == b.shape and bool(np.all(np.abs(a - b) <= 1e-9 * np.abs(b).max(initial=0.0)))


def _words(times: Float[np.ndarray, " time"]) -> str:
    return f"{counted(times.size, 'sample')} from {times[0]:.4g} to {times[-1]:.4g} s"


TOLERANCE = 1e-7  # relative to the largest deflection
MAX_STEPS_PER_SAMPLE = 10**5  # time steps between samples of a controlled run
MAX_UNCOMPILED_EVENTS = 10000  # of a concrete run; with more, compilation takes less time
# Bound on closed-loop over open-loop step error; largest seen: 5000, of predictive control, whose
# programs are ill-conditioned.
AMPLIFICATION = 1e4
# Step length between samples over that of the trials, which begin at load events: where forces
# change sharply, errors were up to fourteen times as large with steps that begin elsewhere.
TRIAL_STEP_FRACTION = 0.8
SPACING_TOLERANCE = 1e-6  # largest deviation of equally spaced samples, relative to the spacing
MAX_LEAD = 1000  # largest number of steps before the first sample, if there are fewer samples


class IntegrationPlan(Module):
    """Integration plan: static shapes, steps per sample interval, estimated error.

    Valid for cases that differ in numbers only, if these keep the order of supports and loads and
    change frequencies little. `substeps` is the number of steps from sample to sample (with a
    controller from event to event), `error` relative to the largest deflection, `sensor_errors`
    to the largest value of what each sensor measures (empty where they are not estimated).
    `lead_samples` are added before the first sample, back to the start of the run. The run ends
    with the last sample, or `to_duration` at the duration of the case. With a controller the
    `schedule` holds its events, the samples and the end. The `origin` is what the plan was made
    for, with which a case is compared before it is run by the plan; None where the caller answers
    for that. Errors `of_peaks` hold those of peaks between steps, else of the steps only.
    """

    shapes: StaticShapes = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    lead_samples: int = eqx.field(static=True)
    equally_spaced: bool = eqx.field(static=True)
    error: float = eqx.field(static=True)
    schedule: EventSchedule | None = None
    to_duration: bool = eqx.field(static=True, default=False)
    sensor_errors: tuple[float, ...] = eqx.field(static=True, default=())
    origin: PlanOrigin | None = eqx.field(static=True, default=None)
    of_peaks: bool = eqx.field(static=True, default=False)

    def without_statements(self) -> "IntegrationPlan":
        """The plan without errors and origin, so that runs that differ in these use one program."""
        return dataclasses.replace(self, error=0.0, sensor_errors=(), origin=None)


# Function of a plan and an input policy: states of a run at all events, as `beam_and_vehicles`, and
# commands there.
FirstRun = Callable[[IntegrationPlan, AbstractInputPolicy], tuple[Array, Array]]


def integration_plan(
    case: Case,
    times: Float[Array, " time"] | None = None,
    tolerance: float = TOLERANCE,
    first_run: FirstRun | None = None,
    moving: bool = False,
) -> IntegrationPlan:
    """Integration plan of a case with concrete numbers, for samples at `times` (s).

    Default times are those of the run, which ends at its duration. `tolerance` is relative to the
    largest deflection. A `first_run` with the longest steps may take the place of the first trial
    run of a controlled case that is not compiled. A `moving` plan of a controlled case holds for
    other periods and delays too, as long as the number and order of events stay; so is made, for
    derivatives, where these or times of samples are traced. Raises ValueError for an invalid case,
    RuntimeError if no time step meets the tolerance.
    """
    check_tolerance(tolerance)
    if times is not None:
        check_times(times)
    check_case(case)
    if case.lifts:
        raise ValueError(ONE_RUN)
    moving = case.controller is not None and (moving or moves_events(case, times))
    case = concrete_case(case)
    shapes = static_shapes(case)
    to_duration = times is None
    samples = np.asarray(sample_times(case) if to_duration else concrete(times))
    origin = PlanOrigin(case, samples, float(model_limits(case, shapes.layout)[0]))
    if case.controller is not None:
        end = float(case.run.duration) if to_duration else None
        schedule = loop_schedule(case, samples, end)

        def plan(substeps, error, errors=()):
            planned = loop_schedule(case, samples, end, True) if moving else schedule
            parts = shapes, substeps, 0, False, error, planned, to_duration, errors
            return IntegrationPlan(*parts, origin)

        def run_first(substeps, policy):
            assert first_run is not None
            return first_run(plan(substeps, 0.0), policy)

        by_first_run = None if first_run is None else run_first
        substeps, error, trial = _choose_substeps(case, shapes, schedule, tolerance, by_first_run)
        return plan(substeps, error, _sensor_errors(case, shapes, trial))
    intervals = np.diff(samples)
    equally_spaced = bool(
        np.all(np.abs(intervals - intervals.mean()) < SPACING_TOLERANCE * intervals.mean())
    )
    needed = int(np.ceil(samples[0] / intervals.mean() - SPACING_TOLERANCE))
    lead_samples = min(needed, max(samples.size, MAX_LEAD))
    schedule = run_schedule(case, samples, equally_spaced, lead_samples, to_duration)
    step, error, trial = choose_step_size(case, shapes, tolerance, schedule)
    substeps, error_ratio = trial.substeps, 1.0
    if not substeps:
        longest = max(intervals.max(), samples[0] / max(lead_samples, 1))
        substeps, error_ratio = _substeps_and_error_ratio(trial, step, longest)
        check_step_count(float((lead_samples + samples.size) * substeps), longest / substeps)
    return IntegrationPlan(
        shapes,
        substeps,
        lead_samples,
        equally_spaced,
        error_ratio * error,
        to_duration=to_duration,
        sensor_errors=tuple(error_ratio * each for each in _sensor_errors(case, shapes, trial)),
        origin=origin,
    )


def check_plan(case: Case, plan: IntegrationPlan, times) -> IntegrationPlan:
    """The plan for a run of a case sampled at `times` (s); its errors are NaN for other numbers.

    Raises ValueError, in one sentence, if the plan is that of another case or of other times.
    """
    if plan.origin is None:
        return plan
    lengths = np.diff(concrete(times)) if is_concrete(times) else np.array([np.inf])
    schedule = own = plan.schedule
    if schedule is not None and case.controller is not None:
        with contextlib.suppress(jax.errors.ConcretizationTypeError):  # of traced events
            end = float(concrete(case.run.duration)) if plan.to_duration else None
            own = loop_schedule(case, concrete(times), end, schedule.source is not None)
        lengths = np.asarray(own.lengths)
    steps_per_limit = float(lengths.max()) / plan.substeps / plan.origin.max_stable_step
    same = check_origin(plan.origin, plan.shapes, case, times, steps_per_limit, plan.error)
    if same and not any_jax(case, times):
        return plan
    if schedule is not None:
        check_same_events(schedule, own)
    if same:
        return plan
    return dataclasses.replace(
        plan, error=np.nan, sensor_errors=(np.nan,) * len(plan.sensor_errors)
    )


def check_times(times) -> None:
    """Raises ValueError for times (s) that are not finite, ascending, or from the start on."""
    if not is_concrete(times):
        return
    times = concrete(real_numbers("times", times, "s"))
    if times.ndim != 1 or times.size < 2:
        raise ValueError(
            f"times must be at least two numbers in a list; its shape is {times.shape}"
        )
    if not np.all(np.isfinite(times)) or not np.all(np.diff(times) > 0):
        raise ValueError("times (s from the start of the run) must be finite and ascend")
    if times[0] < 0:
        raise ValueError(
            f"times (s) count from the start of the run, so that none is before 0; the first is"
            f" {times[0]:g}"
        )


def _substeps_and_error_ratio(trial: StepTrial, step: float, interval: float) -> tuple[int, float]:
    """Number of steps in an interval (s) between samples, and their error over that of the trial.

    Steps of the trial are at most a `step` (s); those of the run are at most TRIAL_STEP_FRACTION of
    them. A single step between two load events may be as long as that of the trial.
    """
    times, steps = trial.panels
    several = steps < times
    longest = TRIAL_STEP_FRACTION * np.min(steps[several], initial=step)
    substeps = steps_per_interval(interval, longest)
    of_run = np.minimum(times, interval) / substeps
    ratios = np.minimum(of_run / (TRIAL_STEP_FRACTION * steps), 1.0)
    return substeps, float(np.max(ratios, initial=0.0)) ** CONVERGENCE_ORDER


def run_schedule(
    case: Case, times, equally_spaced: bool, lead_samples: int, to_duration: bool
) -> EventSchedule:
    """Schedule of a run without controller that is sampled at ascending times (s).

    From rest at t = 0 to the first sample in so many equal steps; the run ends with the last
    sample, or `to_duration` at that of the case.
    """
    lead_times = times[0] * (np.arange(lead_samples) / max(lead_samples, 1))
    all_times = xp.concatenate([lead_times, times])
    end = case.run.duration if to_duration else None
    return sample_schedule(all_times, equally_spaced, lead_samples, end)


def common_plan(plans: Sequence[IntegrationPlan], what: str = "cases") -> IntegrationPlan:
    """Plan for several cases that differ in numbers only: the largest number of loads and steps.

    The error is the largest of all that have one, as runs that diverge have none; the schedule is
    that of the first. Raises ValueError, which names the cases by `what`, if they differ in the
    order of positions along the beam.
    """
    first = plans[0]
    layout = largest_layout([plan.shapes.layout for plan in plans])
    if layout is None:
        raise ValueError(
            f"the {what} differ in the order of positions along the beam; treat them separately"
        )
    shapes = dataclasses.replace(
        first.shapes,
        layout=layout,
        coupled=any(plan.shapes.coupled for plan in plans),
        max_loads=max(plan.shapes.max_loads for plan in plans),
    )
    return dataclasses.replace(
        first,
        shapes=shapes,
        substeps=max(plan.substeps for plan in plans),
        lead_samples=max(plan.lead_samples for plan in plans),
        equally_spaced=all(plan.equally_spaced for plan in plans),
        error=float(np.fmax.reduce([plan.error for plan in plans])),
        of_peaks=all(plan.of_peaks for plan in plans),
        sensor_errors=tuple(np.fmax.reduce([plan.sensor_errors for plan in plans]).tolist()),
        origin=common_origin([plan.origin for plan in plans]),
    )


def sample_times(case: Case) -> Float[Array, " time"]:
    """Times (s) of the samples of a run: from 0 to its duration at its sample rate.

    A run too short for a second sample has one at its end. Raises ValueError as `sample_count`.
    """
    return times_of_samples(case, sample_count(case))


def sample_count(case: Case) -> int:
    """Number of samples of a run, from its duration and its sample rate.

    Raises ValueError if there are more than MAX_SAMPLES, or of all sensors together than
    MAX_SAMPLED.
    """
    duration, rate = float(concrete(case.run.duration)), float(concrete(case.run.sample_rate))
    channels = max(1, len(case.sensors))
    limit = min(MAX_SAMPLES, MAX_SAMPLED / channels)
    if duration * rate > limit:
        of_sensors = f" of {channels} sensors" if limit < MAX_SAMPLES else ""
        raise ValueError(
            f"run.duration ({duration:g} s) and run.sample_rate ({rate:g} Hz) make"
            f" {duration * rate:.3g} samples{of_sensors}, more than {limit:.0e}: lower one of them"
        )
    return int(np.floor(duration * rate * (1 + 1e-12))) + 1


def times_of_samples(case: Case, count: int) -> Float[Array, " time"]:
    """Times (s) of so many samples of a run; 0 and the end of one too short for a second."""
    if count == 1:
        return xp.stack([xp.zeros(()), xp.asarray(case.run.duration)])
    return xp.arange(count) / case.run.sample_rate


def _choose_substeps(
    case: Case,
    shapes: StaticShapes,
    schedule: EventSchedule,
    tolerance: float,
    first_run: Callable[[int, AbstractInputPolicy], tuple[Array, Array]] | None,
) -> tuple[int, float, StepTrial | None]:
    """Number of steps between events of a schedule, relative error of the deflection, and trial.

    A `first_run` takes the smallest number of steps. If its response to the same commands in steps
    half as long differs so little that the loop could not amplify the difference to the tolerance,
    these steps are taken, and the error is the amplified difference. The trial of a run that
    diverges is None.
    """
    step, interval = longest_trial_step(case, shapes), float(schedule.lengths.max())
    if interval / step > MAX_STEPS_PER_SAMPLE:
        raise RuntimeError(
            f"the interval of {interval:g} s between samples takes {interval / step:.1e} time steps"
            f" of {step:.1e} s, more than {MAX_STEPS_PER_SAMPLE:.0e};"
            " give a shorter controller.period or a higher run.sample_rate"
        )
    check_step_count(schedule.times.size * interval / step, step)
    min_substeps = steps_per_interval(interval, step)

    is_compiled = runs_compiled(schedule)
    trial_run = _compiled_trial_run if is_compiled else _trial_run
    policy = None if is_compiled else loop_of_case(case, shapes.layout, schedule)

    model = modal_model(case, shapes.layout, shapes.coupled)
    least = rounding_deflection(case, model, load_set(case))
    own = slice(None, -1)  # no step starts at the last

    def trial(coarse, fine):
        return StepTrial(schedule.times[own], coarse[own], fine[own])

    @np.errstate(all="ignore")  # of runs that diverge
    def change(coarse, fine):
        return UNSAMPLED * largest_change(case, model, coarse, fine, least)

    first_states = None
    if first_run is not None and policy is not None:
        first_states, commands = map(np.asarray, first_run(min_substeps, policy))
        if not policy.acts_at(np.array([-1])).any():
            held = HeldCommands(policy.model, commands, policy.load_amplitude)
            fine = np.asarray(trial_run(case, shapes, schedule, np.asarray(2 * min_substeps), held))
            error = AMPLIFICATION * change(first_states, fine)
            if error <= tolerance:
                amplified = trial(first_states, fine)._replace(amplification=AMPLIFICATION)
                return min_substeps, error, amplified

    @functools.cache
    def states(halvings):
        if halvings == 0 and first_states is not None:
            return first_states
        substeps = xp.asarray(min_substeps * 2**halvings)
        return np.asarray(trial_run(case, shapes, schedule, substeps, policy))

    # A loop that diverges does so with any step, so its error is not defined. A stiff law in
    # continuous time may also overflow because the steps are too long.
    confirming_halvings = 6 if case.controller.period is None else 1
    if np.isnan(states(1)).any() and np.isnan(states(confirming_halvings)).any():
        return 2 * min_substeps, np.nan, None
    halvings, error = _halve_until_converged(states, change, tolerance, 8)
    return min_substeps * 2**halvings, error, trial(states(halvings), states(halvings + 1))


@np.errstate(all="ignore")  # of extreme numbers
def _sensor_errors(case: Case, shapes: StaticShapes, trial: StepTrial | None) -> tuple[float, ...]:
    """Errors of the steps of a trial at each sensor (see `step_errors`), NaN without one."""
    if trial is None:
        return (np.nan,) * len(case.sensors)
    model = modal_model(case, shapes.layout, shapes.coupled)
    errors = trial.amplification * step_errors(case, model, trial)
    if trial.former is not None:
        errors = np.maximum(errors, trial.error_ratio * step_errors(case, model, trial.former))
    return tuple(map(float, errors))


def runs_compiled(schedule: EventSchedule) -> bool:
    """Whether runs of a controlled case are compiled although its numbers are concrete.

    In NumPy each event takes a fraction of a millisecond, in a program a hundredth of that.
    """
    return schedule.times.shape[0] > MAX_UNCOMPILED_EVENTS


def beam_and_vehicles(
    case: Case, shapes: StaticShapes, policy: AbstractInputPolicy, states
) -> Float[Array, "event state batch"]:
    """States of beam and vehicles of a controlled run, without those of filters and controller."""
    own = modal_model(case, shapes.layout, shapes.coupled).state_count
    return xp.concatenate([states[:, :own], states[:, policy.model.state_count :]], axis=1)


def _closed_loop_trial_run(case, shapes, schedule, substeps, policy):
    """States at all events, of the beam's modal model and then of vehicles: (event, state, batch).

    The input `policy` is that of the case if it is None. Peaks would hide errors: where a command
    saturates, the deflection has its error everywhere but at a peak, where it is stationary.
    """
    loads = load_set(case, shapes.layout)
    policy = policy or closed_loop(case, shapes.layout, loads, schedule)
    grid = grid_by_schedule(case, policy.model, schedule, substeps)
    discrete = discrete_model(policy.model, grid, None, policy)
    states = integrate_at_events(discrete, loads, max_loads=shapes.max_loads, policy=policy)
    return beam_and_vehicles(case, shapes, policy, states[: schedule.times.shape[0]])


_trial_run = compiled_if_traced(_closed_loop_trial_run)
_compiled_trial_run = compiled(_closed_loop_trial_run)


def _halve_until_converged(
    states: Callable[[int], np.ndarray],
    change: Callable[[np.ndarray, np.ndarray], float],
    tolerance: float,
    max_halvings: int,
) -> tuple[int, float]:
    """Number of halvings of a step after which one more changes the states within a tolerance.

    And the `change` of the states by that one more; `states` returns those after a number of
    halvings. Raises RuntimeError if no number up to `max_halvings` suffices.
    """
    coarse, floor = states(0), ErrorFloor(tolerance)
    for halvings in range(max_halvings):
        fine = states(halvings + 1)
        error = change(coarse, fine)
        if error <= tolerance:
            return halvings, error
        floor.check(error, 0.5**halvings)
        if halvings >= MAX_DIVERGED_HALVINGS and not np.isfinite(fine).all():
            break
        coarse = fine
    if not np.isfinite(error):
        raise RuntimeError(NO_STEP.format(tolerance))
    raise RuntimeError(
        f"no time step makes the response agree to {tolerance:g}, and the shortest one to"
        f" {error:.1e}, as forces bend or jump within it; give a tolerance above that, or a law in"
        " continuous time a period"
    )
