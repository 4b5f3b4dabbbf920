"""Step size of a run without controller, by the error of its deflections.

A run of the case is compared with one whose steps are half as long. The order of the error is at
least CONVERGENCE_ORDER, so that the next trial is close to the longest step that suffices.

Where forces change sharply, the error depends on where in a step they do: the forces that Gauss
nodes integrate worst are those with a singularity near the middle of a step, close to the real axis
(Trefethen 2008, "Is Gauss quadrature better than Clenshaw-Curtis?"). Errors of equal
steps that begin elsewhere have differed by a factor of five hundred. So wherever samples are no
closer than steps, the steps of the trials are those of the run itself, between its samples.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.arguments import describe_value
from jaxbeam.case.case import Case, concrete_case, replace
from jaxbeam.case.fields import concrete, is_real, refuse_traced
from jaxbeam.case.toml_file import MAX_SAMPLES
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel, has_coupling, modal_model
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.simulation.integrator.discrete_model import discrete_model
from jaxbeam.simulation.integrator.integrate import (
    integrate_history,
    longest_force_step,
    max_stable_step,
)
from jaxbeam.simulation.integrator.time_grid import (
    EventSchedule,
    LoadEvents,
    TimeGrid,
    event_places,
    grid_by_schedule,
    grid_by_step_length,
)


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
    _, repeated, entry_exit = model_limits(case, layout)
    return StaticShapes(
        layout, has_coupling(case) or bool(repeated), max_concurrent_loads(np.asarray(entry_exit))
    )


@compiled_if_traced
def model_limits(case: Case, layout: Layout):
    """Longest stable step (s), whether frequencies repeat, entry and exit times (load, 2) in s."""
    model, loads = modal_model(case, layout), load_set(case, layout)
    limit = longest_stable_step(case, model, loads)
    return limit, model.modes.has_repeated, loads.entry_exit_times()


def longest_stable_step(case: Case, model: ModalModel, loads: LoadSet) -> Float[Array, ""]:
    """Longest step (s) that is stable and resolves the passages of forces."""
    return xp.minimum(max_stable_step(model, loads), longest_force_step(case, loads))


def max_concurrent_loads(entry_exit_times: Float[np.ndarray, "load 2"]) -> int:
    """Largest number of loads on the beam at once; at least one if there are any."""
    entries, exits = entry_exit_times.T
    # The number increases only when a load enters.
    on_beam = (entries[None, :] <= entries[:, None]) & (entries[:, None] < exits[None, :])
    return max(min(1, entries.size), int(np.max(on_beam.sum(axis=1), initial=0)))


MAX_TRIALS = 40  # step sizes tried
CONVERGENCE_ORDER = 9  # assumed order of the error in the step; the true order is higher
CLOSE_SAMPLES = 0.5  # fraction of a step; closer samples need no trial with their own steps
MAX_DIVERGED_HALVINGS = 6  # halvings of the step after which a run that overflows is given up
NO_STEP = (
    "no time step makes the response agree to {:g}; it is unstable, or its frequencies are too far"
    " apart: check stiffnesses, masses and damping, or keep fewer modes (beam.modes)"
)
ROUNDING = 1e-9  # fraction of the deflection under all loads; smaller ones are not compared
SMALLEST_TOLERANCE = 1e-14  # some fifty units in the last place of double precision
LARGEST_ROUNDING = 1e-9  # largest error that may be rounding, where shorter steps do not lessen it
UNSAMPLED = 2.0  # largest error at any position and time over the largest one that is compared
LEAST_TRIAL_POSITIONS = 8  # at which errors are measured
TRIAL_CHUNK = 2048  # times of a trial whose deflections are compared at once


class StepTrial(NamedTuple):
    """States of two trial runs at the same `times` (s): `coarse`, and `fine` with halved steps.

    States are those of the beam's modal model, then of vehicles. Errors are at least `error_ratio`
    times those of the `former` trial, if there was one. With `substeps` steps divide the intervals
    of a schedule; if it is zero they begin at load events, and `panels` are the times (s) between
    load events with loads on the beam, and the steps (s) there. The error of a run is
    `amplification` times that of the trial where the trial leaves the control law out.
    """

    times: Float[np.ndarray, " time"]
    coarse: Float[np.ndarray, "time state batch"]
    fine: Float[np.ndarray, "time state batch"]
    former: "StepTrial | None" = None
    error_ratio: float = 0.0
    substeps: int = 0
    panels: Float[np.ndarray, "2 panel"] = np.zeros((2, 0))
    amplification: float = 1.0


def check_step_count(count: float, step: float) -> None:
    """Raises RuntimeError if a run has more than MAX_SAMPLES time steps, of `step` (s)."""
    if not count <= MAX_SAMPLES:
        raise RuntimeError(
            f"the run takes {count:.1e} time steps of {step:.1e} s, more than {MAX_SAMPLES:.0e}:"
            " check stiffnesses, masses and damping, shorten the run, or keep fewer modes"
            " (beam.modes)"
        )


def check_tolerance(tolerance: float) -> None:
    """Raises ValueError for a tolerance not below 1, below double precision, or traced."""
    refuse_traced("a tolerance", "give a known number", tolerance)
    if not is_real(tolerance) or np.ndim(tolerance):
        raise ValueError(
            f"tolerance takes one number, such as 1e-6, not {describe_value(tolerance)}"
        )
    if not SMALLEST_TOLERANCE <= tolerance < 1:
        raise ValueError(
            f"tolerance must be at least {SMALLEST_TOLERANCE:g} and below 1, as a fraction of the"
            f" largest deflection in double precision; it is {tolerance:g}"
        )


class ErrorFloor:
    """Detector of rounding errors: they do not fall with ever shorter steps.

    The order of the integrator divides an error by 512 at least as steps are halved.
    """

    def __init__(self, tolerance: float):
        self._tolerance, self._best, self._step = tolerance, np.inf, np.inf

    def check(self, error: float, step: float) -> None:
        """Record the error of a step (s).

        Raises RuntimeError if a sixteenth of the step of a small error has not halved it. (Between
        close load events there is one step, and an error that falls only when it is divided.)
        """
        if error < 0.5 * self._best:
            self._best, self._step = error, step
        elif self._best < LARGEST_ROUNDING and step <= self._step / 16:
            raise RuntimeError(
                f"no time step makes the response agree to {self._tolerance:g}: in double precision"
                f" it agrees to {self._best:.1e}; give a tolerance of {4 * self._best:.0e} or more"
            )


def longest_trial_step(case: Case, shapes: StaticShapes) -> float:
    """Longest step (s) of trial runs."""
    return min(float(model_limits(case, shapes.layout)[0]), float(concrete(case.run.duration)))


@np.errstate(all="ignore")  # of extreme numbers, and of runs that diverge
def choose_step_size(
    case: Case, shapes: StaticShapes, tolerance: float, schedule: EventSchedule | None = None
) -> tuple[float, float, StepTrial]:
    """Longest step (s) whose deflections meet the `tolerance`, their error, and the last trial.

    The error is measured in the last trial. With a `schedule` of samples the trial takes the steps
    of a run with these samples, unless samples are closer than CLOSE_SAMPLES of a step.

    The step is shortened until dividing it by two changes no deflection at the trial positions and
    the ends of its steps by more than half the tolerance, relative to the largest; the error is
    twice that change, as it is larger at other positions and times. Peaks alone would hide errors,
    as the deflection is stationary there. The error of steps between load events is at least that
    of the former trial times the ratio of the steps to the power of CONVERGENCE_ORDER: a single
    change may be far smaller than that of a run whose steps begin elsewhere.

    Raises RuntimeError if no step meets the tolerance.
    """
    case = concrete_case(case)
    step = longest_trial_step(case, shapes)
    check_step_count(float(concrete(case.run.duration)) / step, step)
    model = modal_model(case, shapes.layout, shapes.coupled)
    loads = load_set(case, shapes.layout)
    events = loads.events(event_places(model, None))
    case = without_later_vibration(case, model, loads)
    schedule = None if schedule is None else _until(schedule, float(case.run.duration))
    halvings, least, floor = 0, rounding_deflection(case, model, loads), ErrorFloor(tolerance)
    former, former_error, shrink = None, 0.0, 0.0
    for _ in range(MAX_TRIALS):
        step, substeps = _step_and_substeps(schedule, step)
        (times, coarse), (_, fine) = (
            run_of_grid(grid, model, loads, shapes.max_loads)
            for grid in _grids(case, model, events, step, schedule, substeps)
        )
        trial = StepTrial(times, coarse, fine[::2], substeps=substeps)
        change = UNSAMPLED * largest_change(case, model, coarse, trial.fine, least)
        error, ratio = change, shrink**CONVERGENCE_ORDER
        if not substeps:
            error, trial = max(change, ratio * former_error), trial._replace(former=former)
        if error <= tolerance:
            panels = _loaded_panels(case, model, events, step)
            return step, error, trial._replace(error_ratio=ratio, panels=panels)
        floor.check(change, step)
        shrink, former, former_error = 0.5, None, 0.0
        if np.isfinite(error):
            shrink = 0.9 * (tolerance / error) ** (1 / CONVERGENCE_ORDER)
            shrink = float(np.clip(shrink, 0.2, 0.8))
            former, former_error = trial._replace(former=None), change
        elif (halvings := halvings + 1) > MAX_DIVERGED_HALVINGS:
            break
        step *= shrink
    raise RuntimeError(NO_STEP.format(tolerance))


def steps_per_interval(interval: float, max_step: float) -> int:
    """Smallest number of equal steps of at most `max_step` (s) in an interval (s)."""
    return max(1, int(np.ceil(interval / max_step)))


def _until(schedule: EventSchedule, end: float) -> EventSchedule:
    """Schedule of samples up to the first one at or after an end (s)."""
    count = max(2, int(np.searchsorted(schedule.times, end)) + 1)
    times, index = schedule.times[:count], schedule.length_index[: count - 1]
    return EventSchedule(times, index, schedule.lengths, np.arange(len(times)))


def _step_and_substeps(schedule: EventSchedule | None, step: float) -> tuple[float, int]:
    """Longest of the equal steps (s) in the intervals of a schedule, and their number in each.

    It is the given step, and zero, where intervals are shorter than CLOSE_SAMPLES of the step.
    """
    interval = 0.0 if schedule is None else float(np.max(schedule.lengths))
    if interval < CLOSE_SAMPLES * step:
        return step, 0
    substeps = steps_per_interval(interval, step)
    return interval / substeps, substeps


def _grids(
    case: Case,
    model: ModalModel,
    events: LoadEvents,
    step: float,
    schedule: EventSchedule | None,
    substeps: int,
) -> list[TimeGrid]:
    """Two grids of a trial: with a step (s) or `substeps` per interval, and with halved steps."""
    if schedule is None or not substeps:
        max_step = np.asarray(step)
        return [
            grid_by_step_length(case, model, max_step, refinement=n, given_events=events)
            for n in (1, 2)
        ]
    check_step_count(float(schedule.times.size * substeps), step)
    return [grid_by_schedule(case, model, schedule, n * substeps) for n in (1, 2)]


def _loaded_panels(
    case: Case, model: ModalModel, events: LoadEvents, step: float
) -> Float[np.ndarray, "2 panel"]:
    """Lengths (s) of the panels with loads on the beam, and their steps (s) of at most `step`.

    Panels of zero length, between events at one time, are left out.
    """
    grid = grid_by_step_length(case, model, np.asarray(step), given_events=events)
    times, loaded = np.diff(grid.boundaries), np.any(grid.loads_on_beam, axis=1)
    return np.stack([times, np.asarray(grid.lengths)[:-1]])[:, loaded & (times > 0)]


def without_later_vibration(case: Case, model: ModalModel, loads: LoadSet) -> Case:
    """Case whose run ends one period of the lowest mode after the last exit, or earlier.

    Free vibration is exact with any step, and no error grows in it.
    """
    lowest = float(np.sqrt(np.maximum(np.min(model.modes.stiffness), 0.0)))
    last_exit = float(np.max(loads.entry_exit_times(), initial=0.0))
    end = last_exit + 2 * np.pi / lowest if lowest > 0 else np.inf
    return replace(case, {"run.duration": min(end, float(concrete(case.run.duration)))})


def trial_run(
    case: Case, model: ModalModel, loads: LoadSet, max_loads: int, max_step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Step boundaries (s) and states there (boundary, state, batch) of a run without controller.

    Steps are at most `max_step` (s), with at most `max_loads` on the beam at once.
    """
    grid = grid_by_step_length(case, model, np.asarray(max_step))
    return run_of_grid(grid, model, loads, max_loads)


def run_of_grid(
    grid: TimeGrid, model: ModalModel, loads: LoadSet, max_loads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Boundaries of the steps of a grid (s), and states there (boundary, state, batch)."""
    discrete, steps = discrete_model(model, grid, None), int(grid.step_count)
    _, states, *_ = integrate_history(discrete, loads, max_loads=max_loads, steps=steps)
    _, starts, _ = grid.locate_steps(np.arange(steps))
    return np.append(starts, grid.boundaries[-1]), np.asarray(states)


def trial_positions(case: Case) -> Float[Array, " position"]:
    """Positions (m) at which errors are measured: twice as many as modes, to resolve all modes."""
    count = max(LEAST_TRIAL_POSITIONS, 2 * case.beam.modes)
    return case.beam.length * (np.arange(count) + 0.5) / count


def largest_change(
    case: Case,
    model: ModalModel,
    coarse: Float[np.ndarray, "time state batch"],
    fine: Float[np.ndarray, "time state batch"],
    least: float,
) -> float:
    """Largest relative change of deflections at the trial positions between two runs.

    `coarse` and `fine` are states. The change is relative to the largest deflection of each `fine`
    run of the batch, or to `least` (m) where that is larger.
    """
    rows, own = model.shapes(trial_positions(case), (0,))[0], np.s_[:, 0 : 2 * case.beam.modes : 2]
    coarse, fine = coarse[own], fine[own]
    change = largest = np.zeros(coarse.shape[2])
    for i in range(0, len(coarse), TRIAL_CHUNK):
        deflections, exact = (rows @ part[i : i + TRIAL_CHUNK] for part in (coarse, fine))
        change = np.maximum(change, np.max(np.abs(deflections - exact), axis=(0, 1)))
        largest = np.maximum(largest, np.max(np.abs(exact), axis=(0, 1)))
    if not np.any(largest):
        return 0.0
    return float(np.max(change / np.maximum(largest, least), initial=0.0))


def rounding_deflection(case: Case, model: ModalModel, loads: LoadSet) -> float:
    """Deflection (m) below which changes may be rounding: ROUNDING of that under all loads.

    Loads that stand on supports cause no deflection, and their rounding does not fall with the
    step.
    """
    times = np.linspace(0.0, float(concrete(case.run.duration)), 100)
    weight = np.max(np.sum(np.abs(loads.varying_weight(times)), axis=1), initial=0.0)
    rows = model.shapes(trial_positions(case), (0,))[0]
    stiffness = np.where(model.modes.stiffness > 0, model.modes.stiffness, np.inf)
    return ROUNDING * float(weight * np.max(np.sum(rows**2 / stiffness, axis=1)))
