"""Integration plan of a case: array shapes and step size, chosen before compilation.

A plan is computed from concrete numbers and is static in the compiled code, which then holds for
all numbers for which the plan is valid.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete
from jaxbeam.case.validation import check_case
from jaxbeam.integrator.discrete_model import discrete_model
from jaxbeam.integrator.events import EventSchedule
from jaxbeam.integrator.integrate import (
    integrate_at_events,
    integrate_peaks,
    longest_force_step,
    max_stable_step,
)
from jaxbeam.integrator.running_peaks import RunningPeaks
from jaxbeam.integrator.time_grid import grid_by_schedule, grid_by_step_length
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import has_coupling, modal_model
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.compiling import compiled, compiled_if_traced
from jaxbeam.simulation.closed_loop import closed_loop, loop_schedule

TOLERANCE = 1e-7  # relative to the largest deflection
MAX_STEPS = 10**8  # samples or time steps of a run; more exceed memory or take days
MAX_STEPS_PER_SAMPLE = 10**5  # time steps between samples of a controlled run
MAX_DIVERGED_HALVINGS = 6  # halvings of the step after which a run that overflows is given up
SPACING_TOLERANCE = 1e-6  # largest deviation of equally spaced samples, relative to the spacing
TRIAL_POSITIONS = (0.13, 0.29, 0.47, 0.62, 0.88)  # x / length at which errors are measured


@dataclasses.dataclass(frozen=True)
class StaticShapes:
    """Static data that fix array shapes.

    Layout of supports and patches, coupling of modes, largest number of loads on the beam at once;
    and whether runs without an input policy are integrated in C (`native`).
    """

    layout: Layout
    coupled: bool
    max_loads: int
    native: bool = False


def static_shapes(case: Case) -> StaticShapes:
    """Static shapes of a case with concrete numbers (not inside `jit`)."""
    case = concrete_case(case)
    layout = mesh_layout(case)
    _, repeated, entry_exit = _model_limits(case, layout)
    return StaticShapes(
        layout, has_coupling(case) or bool(repeated), max_concurrent_loads(np.asarray(entry_exit))
    )


@compiled_if_traced
def _model_limits(case: Case, layout: Layout):
    """Longest stable step (s), whether frequencies repeat, entry and exit times (load, 2) in s."""
    model, loads = modal_model(case, layout), load_set(case)
    limit = xp.minimum(max_stable_step(model, loads), longest_force_step(case, loads))
    return limit, model.modes.has_repeated, loads.entry_exit_times()


def max_concurrent_loads(entry_exit_times: Float[np.ndarray, "load 2"]) -> int:
    """Largest number of loads on the beam at once; at least one if there are any."""
    entries, exits = entry_exit_times.T
    # The number increases only when a load enters.
    on_beam = (entries[None, :] <= entries[:, None]) & (entries[:, None] < exits[None, :])
    return max(min(1, entries.size), int(np.max(on_beam.sum(axis=1), initial=0)))


def run_peaks(
    case: Case,
    shapes: StaticShapes,
    max_step: Float[Array, ""],
    positions: Float[Array, " sensor"],
    load_batch: LoadSet | None = None,
) -> RunningPeaks:
    """Running peaks of an uncontrolled run at positions (m), with steps of at most `max_step` (s).

    `load_batch` holds the loads of several runs of the case; default: those of the case.
    """
    model = modal_model(case, shapes.layout, shapes.coupled)
    grid = grid_by_step_length(case, model, max_step)
    loads = load_set(case) if load_batch is None else load_batch
    return integrate_peaks(
        discrete_model(model, grid, positions), loads, max_loads=shapes.max_loads
    )[0]


class IntegrationPlan(eqx.Module):
    """Integration plan: static shapes, steps per sample interval, estimated error.

    Valid for cases that differ in numbers only, if these keep the order of supports and loads and
    change frequencies little. `substeps` is the number of steps from sample to sample (with a
    controller from event to event), `error` relative to the largest deflection. `lead_samples` are
    added before the first sample, back to the start of the run. The run ends with the last sample,
    or `to_duration` at the duration of the case. With a controller the `schedule` holds its events,
    the samples and the end.
    """

    shapes: StaticShapes = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    lead_samples: int = eqx.field(static=True)
    equally_spaced: bool = eqx.field(static=True)
    error: float = eqx.field(static=True)
    schedule: EventSchedule | None = None
    to_duration: bool = eqx.field(static=True, default=False)


def integration_plan(
    case: Case, times: Float[Array, " time"] | None = None, tolerance: float = TOLERANCE
) -> IntegrationPlan:
    """Integration plan of a case with concrete numbers, for samples at `times` (s).

    Default times are those of the run, which ends at its duration. `tolerance` is relative to the
    largest deflection. Raises ValueError for an invalid case, RuntimeError if no time step meets
    the tolerance.
    """
    check_case(case)
    case = concrete_case(case)
    shapes = static_shapes(case)
    to_duration = times is None
    samples = np.asarray(sample_times(case) if to_duration else concrete(times))
    if case.controller is not None:
        end = float(case.run.duration) if to_duration else None
        schedule = loop_schedule(case, samples, end)
        substeps, error = _choose_substeps(case, shapes, schedule, tolerance)
        return IntegrationPlan(shapes, substeps, 0, False, error, schedule, to_duration)
    step, error = choose_step_size(case, shapes, tolerance)
    intervals = np.diff(samples)
    equally_spaced = bool(
        np.all(np.abs(intervals - intervals.mean()) < SPACING_TOLERANCE * intervals.mean())
    )
    lead_samples = max(0, int(np.ceil(samples[0] / intervals.mean() - SPACING_TOLERANCE)))
    _check_step_count(samples.size * (intervals.max() / step), step)
    substeps = steps_per_interval(intervals.max(), step)
    return IntegrationPlan(
        shapes, substeps, lead_samples, equally_spaced, error, to_duration=to_duration
    )


def steps_per_interval(interval: float, max_step: float) -> int:
    """Smallest number of equal steps of at most `max_step` (s) in an interval (s)."""
    return max(1, int(np.ceil(interval / max_step)))


def common_plan(plans: Sequence[IntegrationPlan], what: str = "cases") -> IntegrationPlan:
    """Plan for several cases that differ in numbers only: the largest number of loads and steps.

    The error is the largest of all, the schedule that of the first. Raises ValueError, which names
    the cases by `what`, if they differ in the order of positions along the beam.
    """
    first = plans[0]
    if any(plan.shapes.layout != first.shapes.layout for plan in plans):
        raise ValueError(
            f"the {what} differ in the order of positions along the beam; treat them separately"
        )
    shapes = dataclasses.replace(
        first.shapes,
        coupled=any(plan.shapes.coupled for plan in plans),
        max_loads=max(plan.shapes.max_loads for plan in plans),
    )
    return dataclasses.replace(
        first,
        shapes=shapes,
        substeps=max(plan.substeps for plan in plans),
        lead_samples=max(plan.lead_samples for plan in plans),
        equally_spaced=all(plan.equally_spaced for plan in plans),
        error=max(plan.error for plan in plans),
    )


def sample_times(case: Case) -> Float[Array, " time"]:
    """Times (s) of the samples of a run: from 0 to its duration at its sample rate.

    A run too short for a second sample has one at its end. Raises ValueError if there are more than
    MAX_STEPS.
    """
    duration, rate = float(concrete(case.run.duration)), float(concrete(case.run.sample_rate))
    if duration * rate > MAX_STEPS:
        raise ValueError(
            f"run.duration ({duration:g} s) and run.sample_rate ({rate:g} Hz) make"
            f" {duration * rate:.3g} samples, more than {MAX_STEPS:.0e}: lower one of them"
        )
    intervals = int(np.floor(duration * rate * (1 + 1e-12)))
    return xp.arange(intervals + 1) / rate if intervals else xp.array([0.0, duration])


@compiled_if_traced
def _trial_run(case, shapes, max_step, load_batch):
    positions = case.beam.length * xp.array(TRIAL_POSITIONS)
    return run_peaks(case, shapes, max_step, positions, load_batch).refined_peak()[0]


def _check_step_count(count: float, step: float) -> None:
    """Raise RuntimeError if a run has more than MAX_STEPS time steps, of `step` (s)."""
    if not count <= MAX_STEPS:
        raise RuntimeError(
            f"the run takes {count:.1e} time steps of {step:.1e} s, more than {MAX_STEPS:.0e}:"
            " check stiffnesses, masses and damping, shorten the run, or keep fewer modes"
            " (beam.modes)"
        )


def _max_step(case: Case, shapes: StaticShapes) -> float:
    """Longest step (s) of trial runs."""
    return min(float(_model_limits(case, shapes.layout)[0]), float(concrete(case.run.duration)))


def choose_step_size(
    case: Case, shapes: StaticShapes, tolerance: float, load_batch: LoadSet | None = None
) -> tuple[float, float]:
    """Longest step (s) whose peaks at TRIAL_POSITIONS meet the `tolerance`, and their error.

    The step is halved until halving it once more changes no peak by more than the tolerance,
    relative to the largest peak; the error is that change. Raises RuntimeError if no step down to a
    millionth of the run meets it.
    """
    case = concrete_case(case)
    step = _max_step(case, shapes)
    _check_step_count(float(concrete(case.run.duration)) / step, step)

    def peaks(halvings):
        return np.asarray(_trial_run(case, shapes, xp.asarray(step / 2**halvings), load_batch))

    halvings, error = _halve_until_converged(peaks, tolerance, 20)
    return step / 2**halvings, error


def _choose_substeps(case: Case, shapes: StaticShapes, schedule: EventSchedule, tolerance: float):
    """Number of steps between events of a schedule, and the relative error of the deflection."""
    step, interval = _max_step(case, shapes), float(schedule.lengths.max())
    if interval / step > MAX_STEPS_PER_SAMPLE:
        raise RuntimeError(
            f"the interval of {interval:g} s between samples takes {interval / step:.1e} time steps"
            f" of {step:.1e} s, more than {MAX_STEPS_PER_SAMPLE:.0e};"
            " give a shorter controller.period or a higher run.sample_rate"
        )
    _check_step_count(schedule.times.size * interval / step, step)
    min_substeps = steps_per_interval(interval, step)

    trial_run = _compiled_trial_run if case.controller.runs_compiled else _known_trial_run

    @functools.cache
    def response(halvings):
        return np.asarray(trial_run(case, shapes, schedule, xp.asarray(min_substeps * 2**halvings)))

    # A loop that diverges does so with any step, so its error is not defined. A stiff law in
    # continuous time may also overflow because the steps are too long.
    confirming_halvings = 6 if case.controller.period is None else 1
    if np.isnan(response(1)).any() and np.isnan(response(confirming_halvings)).any():
        return 2 * min_substeps, np.nan
    halvings, error = _halve_until_converged(response, tolerance, 8)
    return min_substeps * 2**halvings, error


def _closed_loop_trial_run(case, shapes, schedule, substeps):
    """Deflections (m) at TRIAL_POSITIONS and all events, as (event and position, batch).

    Peaks would hide errors: where a command saturates, the deflection has its error everywhere but
    at a peak, where it is stationary.
    """
    positions = case.beam.length * xp.array(TRIAL_POSITIONS)
    loads = load_set(case)
    policy = closed_loop(case, shapes.layout, loads, schedule)
    grid = grid_by_schedule(case, policy.model, schedule, substeps)
    discrete = discrete_model(policy.model, grid, None, policy)
    states = integrate_at_events(discrete, loads, max_loads=shapes.max_loads, policy=policy)
    rows = policy.model.shapes(positions, (0,))[0]
    deflections = rows @ states[:, 0 : 2 * case.beam.modes : 2]
    return deflections.reshape(-1, deflections.shape[-1])


_known_trial_run = compiled_if_traced(_closed_loop_trial_run)
_compiled_trial_run = compiled(_closed_loop_trial_run)


def _halve_until_converged(
    response: Callable[[int], np.ndarray], tolerance: float, max_halvings: int
) -> tuple[int, float]:
    """Number of halvings of a step until one more changes the response within the tolerance.

    Returns it with that change, relative to the largest response. Raises RuntimeError if no number
    up to `max_halvings` suffices.
    """
    coarse = response(0)
    for halvings in range(max_halvings):
        fine = response(halvings + 1)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            error = np.max(np.abs(coarse - fine) / np.max(np.abs(fine), axis=0), initial=0.0)
        if not np.any(fine):
            error = 0.0
        if error <= tolerance:
            return halvings, float(error)
        if halvings >= MAX_DIVERGED_HALVINGS and not np.isfinite(fine).all():
            break
        coarse = fine
    raise RuntimeError(
        f"no time step makes the response agree to {tolerance:g}; it is unstable, or its "
        "frequencies are too far apart: check stiffnesses, masses and damping, or keep fewer modes "
        "(beam.modes); or a law in continuous time switches too often: give it a period, or a "
        "larger tolerance"
    )
