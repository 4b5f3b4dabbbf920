"""Step size of a run without controller, by the error of its deflections.

A run of the case is compared with one whose steps are half as long. The order of the error is at
least CONVERGENCE_ORDER, so that the next trial is close to the longest step that suffices.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case, replace
from jaxbeam.case.fields import concrete
from jaxbeam.integrator.discrete_model import discrete_model
from jaxbeam.integrator.integrate import integrate_history, integrate_peaks
from jaxbeam.integrator.peaks.running_peaks import RunningPeaks
from jaxbeam.integrator.static_shapes import StaticShapes, model_limits
from jaxbeam.integrator.time_grid import grid_by_step_length
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel, modal_model
from jaxbeam.runtime.arrays import Array, xp

MAX_STEPS = 10**8  # samples or time steps of a run; more exceed memory or take days
MAX_TRIALS = 40  # step sizes tried
CONVERGENCE_ORDER = 9  # assumed order of the error in the step; the true order is higher
MAX_DIVERGED_HALVINGS = 6  # halvings of the step after which a run that overflows is given up
NO_STEP = (
    "no time step makes the response agree to {:g}; it is unstable, or its frequencies are too far"
    " apart: check stiffnesses, masses and damping, or keep fewer modes (beam.modes); or a law in"
    " continuous time switches too often: give it a period, or a larger tolerance"
)
ROUNDING = 1e-9  # of the deflection under all loads; below it, deflections are not compared
SMALLEST_TOLERANCE = 1e-14  # some fifty units in the last place of double precision
LARGEST_ROUNDING = 1e-9  # an error that shorter steps do not lessen, and that may be rounding
# Errors at all positions and times over the largest of those compared. Of random cases up to 1.24:
# experiments/validation/random_cases.
UNSAMPLED = 2.0
TRIAL_POSITIONS = (0.13, 0.29, 0.47, 0.62, 0.88)  # x / length at which errors are measured


class StepTrial(NamedTuple):
    """States of two trial runs at the same `times` (s): with some steps, and with half of them.

    Those of the beam's modal model, then those of vehicles. Errors are at least the `share` of
    those of the `former` trial, if there was one. `shortest` is the step (s) between those load
    events that several lie between: a run of longer ones there may have larger errors. Errors of a
    run whose law is not asked in the trial are the `amplification` of those of the trial.
    """

    times: Float[np.ndarray, " time"]
    coarse: Float[np.ndarray, "time state batch"]
    fine: Float[np.ndarray, "time state batch"]
    former: "StepTrial | None" = None
    share: float = 0.0
    shortest: float = np.inf
    amplification: float = 1.0


def check_step_count(count: float, step: float) -> None:
    """Raises RuntimeError if a run has more than MAX_STEPS time steps, of `step` (s)."""
    if not count <= MAX_STEPS:
        raise RuntimeError(
            f"the run takes {count:.1e} time steps of {step:.1e} s, more than {MAX_STEPS:.0e}:"
            " check stiffnesses, masses and damping, shorten the run, or keep fewer modes"
            " (beam.modes)"
        )


def check_tolerance(tolerance: float) -> None:
    """Raises ValueError for a tolerance that is no share, or below double precision."""
    if not SMALLEST_TOLERANCE <= tolerance < 1:
        raise ValueError(
            f"tolerance must be at least {SMALLEST_TOLERANCE:g} and below 1, as a share of the"
            f" largest deflection in double precision; it is {tolerance:g}"
        )


class ErrorFloor:
    """Notices that errors of ever shorter steps no longer fall: they are rounding then.

    The order of the integrator divides an error by 512 at least as steps are halved.
    """

    def __init__(self, tolerance: float):
        self._tolerance, self._best, self._step = tolerance, np.inf, np.inf

    def check(self, error: float, step: float) -> None:
        """Take note of the error of a step (s).

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
    case: Case, shapes: StaticShapes, tolerance: float
) -> tuple[float, float, StepTrial]:
    """Longest step (s) whose deflections at TRIAL_POSITIONS meet the `tolerance`, and their error.

    The last is the trial from which the error is known.

    The step is shortened until dividing it by two changes no deflection at the ends of its steps by
    more than half the tolerance, relative to the largest; the error is twice that change, as it is
    larger at other positions and times. Peaks alone would hide errors, as the deflection is
    stationary there. The error is at least that of the former trial times the ratio of the steps to
    the power of CONVERGENCE_ORDER: where forces change sharply, a single change may be far smaller
    than the error of a run whose steps begin elsewhere. Raises RuntimeError if no step meets it.
    """
    case = concrete_case(case)
    step = longest_trial_step(case, shapes)
    check_step_count(float(concrete(case.run.duration)) / step, step)
    model = modal_model(case, shapes.layout, shapes.coupled)
    case, loads = without_later_vibration(case, model), load_set(case, shapes.layout)
    halvings, least, floor = 0, rounding_deflection(case, model), ErrorFloor(tolerance)
    former, former_error, shrink = None, 0.0, 0.0
    for _ in range(MAX_TRIALS):
        (times, coarse), (_, fine) = (
            trial_run(case, model, loads, shapes.max_loads, step, divided) for divided in (1, 2)
        )
        deflections = (trial_deflections(case, model, states) for states in (coarse, fine))
        change, share = UNSAMPLED * largest_change(*deflections, least), shrink**CONVERGENCE_ORDER
        error = max(change, share * former_error)
        trial = StepTrial(times, coarse, fine, former, share)
        if error <= tolerance:
            return step, error, trial._replace(shortest=_shortest_step(case, model, step))
        floor.check(change, step)
        shrink, former, former_error = 0.5, None, 0.0
        if np.isfinite(error):
            shrink = np.clip(0.9 * (tolerance / error) ** (1 / CONVERGENCE_ORDER), 0.2, 0.8)
            former, former_error = trial._replace(former=None), change
        elif (halvings := halvings + 1) > MAX_DIVERGED_HALVINGS:
            break
        shrink = float(shrink)
        step = step * shrink
    raise RuntimeError(NO_STEP.format(tolerance))


def _shortest_step(case: Case, model: ModalModel, step: float) -> float:
    """Shortest step (s) among those between load events that are longer than a `step` (s).

    Equal steps between two events may be little longer than half of it.
    """
    grid = grid_by_step_length(case, model, np.asarray(step))
    several = (np.asarray(grid.counts) > 1) & np.any(grid.loads_on_beam, axis=1)
    return float(np.min(np.asarray(grid.lengths)[:-1][several], initial=step))


def without_later_vibration(case: Case, model: ModalModel) -> Case:
    """The case until one period of the lowest mode after the last exit.

    Free vibration is exact with any step, and no error grows in it.
    """
    lowest = float(np.sqrt(np.maximum(np.min(model.modes.stiffness), 0.0)))
    last_exit = float(np.max(load_set(case).entry_exit_times(), initial=0.0))
    end = last_exit + 2 * np.pi / lowest if lowest > 0 else np.inf
    return replace(case, {"run.duration": min(end, float(concrete(case.run.duration)))})


def trial_run(
    case: Case,
    model: ModalModel,
    loads: LoadSet,
    max_loads: int,
    max_step: float,
    divided: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Boundaries of steps of at most `max_step` (s), and states there (boundary, state, batch).

    Of a run without controller, with at most `max_loads` on the beam at once. Each step is
    `divided` into so many.
    """
    grid = grid_by_step_length(case, model, np.asarray(max_step), refinement=divided)
    discrete, steps = discrete_model(model, grid, None), int(grid.step_count)
    _, states, *_ = integrate_history(discrete, loads, max_loads=max_loads, steps=steps)
    _, starts, _ = grid.locate_steps(np.arange(0, steps, divided))
    return np.append(starts, grid.boundaries[-1]), np.asarray(states[::divided])


def trial_deflections(case: Case, model: ModalModel, states):
    """Deflections (m) at TRIAL_POSITIONS from states (boundary, state, batch)."""
    rows = model.shapes(case.beam.length * xp.array(TRIAL_POSITIONS), (0,))[0]
    deflections = rows @ states[:, 0 : 2 * case.beam.modes : 2]
    return deflections.reshape(-1, deflections.shape[-1])


def run_peaks(
    case: Case,
    shapes: StaticShapes,
    max_step: Float[Array, ""],
    positions: Float[Array, " sensor"],
) -> RunningPeaks:
    """Running peaks of an uncontrolled run at positions (m), in steps of at most `max_step` (s)."""
    model = modal_model(case, shapes.layout, shapes.coupled)
    grid = grid_by_step_length(case, model, max_step)
    discrete = discrete_model(model, grid, positions)
    return integrate_peaks(discrete, load_set(case, shapes.layout), max_loads=shapes.max_loads)[0]


def rounding_deflection(case: Case, model: ModalModel) -> float:
    """Deflection (m) that may be all rounding: a share of that of all loads at TRIAL_POSITIONS.

    Loads that stand on supports deflect nothing, and rounding falls with no step.
    """
    loads = load_set(case)
    times = np.linspace(0.0, float(concrete(case.run.duration)), 100)
    weight = np.max(np.sum(np.abs(loads.varying_weight(times)), axis=1), initial=0.0)
    rows = model.shapes(case.beam.length * xp.array(TRIAL_POSITIONS), (0,))[0]
    stiffness = np.where(model.modes.stiffness > 0, model.modes.stiffness, np.inf)
    return ROUNDING * float(weight * np.max(np.sum(rows**2 / stiffness, axis=1)))


def largest_change(coarse: np.ndarray, fine: np.ndarray, least: float = 0.0) -> float:
    """Largest change of responses (value, batch), relative to the largest value of each run.

    Relative to `least` where no value is larger.
    """
    if not np.any(fine):
        return 0.0
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        largest = np.maximum(np.max(np.abs(fine), axis=0), least)
        return float(np.max(np.abs(coarse - fine) / largest, initial=0.0))
