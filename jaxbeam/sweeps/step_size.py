"""Time steps for many runs: measured on a few of them, checked on others.

The longest step that meets a tolerance shrinks with the pace of the loads, at a rate that depends
on the rig; it is measured at a few paces, and between two of them the shorter holds. What was
measured is then tried on runs drawn at random. Runs that are not tried may err more, where the
response changes sharply from run to run: a heavy mass near its critical speed leaves the beam with
ten times the error of one that is a little slower.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

CONVERGENCE_ORDER = 9  # at which errors are taken to fall with the step; the true order is higher
REFINEMENT = 1.25  # how much finer the runs are with which others are compared
MAX_ROUNDS = 12
SAFETY_FACTOR = (
    6  # how much smaller errors must be where they are looked for than they may be elsewhere
)
TARGET_ERROR = 0.6  # of the error allowed: what longer steps aim at
MIN_USEFUL_ERROR = (
    3e-3  # of the error allowed: with less, longer steps are measured before they are trusted
)
LIMIT_RATIO = 1.3  # how far a guess must exceed the limit of a step for that to be taken unmeasured
SAMPLE_DIVISOR = 4  # those tried grow with the root of the number of tasks, divided by this
NEGLIGIBLE_PEAK = 1e-6  # of a run's largest peak: smaller ones need not be right to the tolerance

# Of tasks, their steps (s), and how many steps more between events.
PeaksFunction = Callable[[Int[np.ndarray, " task"], Float[np.ndarray, " task"], int], np.ndarray]


def log_spaced_sample(
    crossing_rates: Float[np.ndarray, " task"], count: int
) -> Int[np.ndarray, " chosen"]:
    """`count` tasks (some maybe twice) from slow ones to the fastest, evenly in log pace.

    The slowest of all are left out: they take longest, and their errors tell least of the others.
    """
    order = np.argsort(crossing_rates, kind="stable")
    logs = np.log(crossing_rates[order])
    targets = np.linspace(logs[0] + (logs[-1] - logs[0]) / (2 * count), logs[-1], count)
    if logs[-1] - logs[0] < 1e-9:
        return order[np.linspace(0, order.size - 1, count).astype(int)]
    return order[np.abs(logs[:, None] - targets).argmin(axis=0)]


def step_errors(
    peaks: PeaksFunction, batches, steps, map_function=map
) -> Float[np.ndarray, " task"]:
    """How much the peaks of tasks, (task, lane, sensor), change with finer steps than these (s).

    The largest relative change in each task. Runs that fail are left out; NaN if all do. Finer is
    one step more between events at least, or between samples of a loop: there may be few of them.
    `map_function` calls a function as `map` does, maybe side by side.
    """
    # The finer take longer, and go first.
    fine, coarse = map_function(peaks, (batches, batches), (steps / REFINEMENT, steps), (1, 0))
    return _relative_changes(coarse, fine)


def rounding_error(exact: Float[np.ndarray, "task lane sensor"], rounded: np.ndarray) -> float:
    """The largest relative error of peaks computed with rounded numbers, where any run works."""
    return float(np.nanmax(_relative_changes(rounded, exact), initial=0.0))


def stratified_sample(
    crossing_rates: Float[np.ndarray, " task"], count: int
) -> Int[np.ndarray, " chosen"]:
    """`count` tasks (some maybe twice), one from each of as many equal parts of all, by pace.

    At random within these parts, and the same each time.
    """
    quantiles = (
        (np.arange(count) + np.random.default_rng(0).random(count)) * crossing_rates.size / count
    )
    return np.argsort(crossing_rates, kind="stable")[quantiles.astype(int)]


def _interpolate_conservatively(
    crossing_rates: Float[np.ndarray, " task"],
    sampled_rates: Float[np.ndarray, " chosen"],
    values: Float[np.ndarray, " chosen"],
) -> Float[np.ndarray, " task"]:
    """The smaller of the values at the known paces next to each; beyond them, that at the end."""
    unique, which = np.unique(sampled_rates, return_inverse=True)
    least = np.full(unique.size, np.inf)
    np.minimum.at(least, which, values)
    above = np.searchsorted(unique, crossing_rates, side="left")
    below = np.searchsorted(unique, crossing_rates, side="right") - 1
    return np.minimum(*(least[np.clip(side, 0, unique.size - 1)] for side in (below, above)))


def _relative_changes(coarse, fine):
    """The largest relative change of peaks in each task; NaN where no run works."""
    works = np.isfinite(fine)
    size = np.abs(np.where(works, fine, 0.0))
    size = np.maximum(size, NEGLIGIBLE_PEAK * size.max(axis=-1, keepdims=True))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        change = np.abs(coarse - fine) / size
    change = np.where(np.isfinite(coarse), change, np.inf)
    change = np.where(works & (size > 0), change, 0.0).max(axis=(1, 2), initial=0.0)
    return np.where(works.any(axis=(1, 2)), change, np.nan)


def choose_step_sizes(
    peaks: PeaksFunction,
    crossing_rates: Float[np.ndarray, " task"],
    initial_steps: Float[np.ndarray, " task"],
    max_steps: Float[np.ndarray, " task"],
    count: int,
    tolerance: float,
    map_function: Callable = map,
) -> tuple[Float[np.ndarray, " task"], float]:
    """Longest steps (s) of all tasks for a tolerance, and the error seen on a random few.

    `peaks` takes tasks, a multiple of `count`, their steps and how many more between events, and
    returns their peaks; `map_function` calls it several times, as `map` does. `crossing_rates` (1/s) order the
    tasks, `initial_steps` start the search, `max_steps` (s) cap it. Raises RuntimeError if no step meets the
    tolerance.
    """
    target_error = tolerance / SAFETY_FACTOR
    chosen = log_spaced_sample(crossing_rates, count)
    good_steps, works = _search_step_sizes(
        peaks, chosen, initial_steps[chosen], max_steps[chosen], target_error, map_function
    )
    if not np.all(good_steps > 0):
        raise _no_step_error(tolerance)
    if not works.any():
        return np.minimum(initial_steps, max_steps), 0.0
    chosen, good_steps = chosen[works], good_steps[works]
    start = np.minimum(initial_steps, max_steps)
    step_ratio = _interpolate_conservatively(
        crossing_rates, crossing_rates[chosen], good_steps / start[chosen]
    )  # than guessed
    steps = np.minimum(start * step_ratio, max_steps)
    sample = stratified_sample(
        crossing_rates, count * max(1, round(np.sqrt(crossing_rates.size / count) / SAMPLE_DIVISOR))
    )
    for _ in range(MAX_ROUNDS):
        error = step_errors(peaks, sample, steps[sample], map_function)
        worst = float(np.max(np.where(np.isnan(error), 0.0, error)))
        if worst <= target_error:
            return steps, worst
        with np.errstate(divide="ignore"):
            steps = steps * max(0.7, 0.95 * (target_error / worst) ** (1 / CONVERGENCE_ORDER))
    raise _no_step_error(tolerance)


def _search_step_sizes(
    peaks: PeaksFunction,
    batches,
    initial_steps,
    max_steps,
    tolerance: float,
    map_function: Callable,
):
    """Long good steps (s) of some tasks, 0 if none was; which of these have a run that works.

    Tasks go from slow to quick.
    """
    steps = np.minimum(initial_steps, max_steps)
    # Slow tasks take longest, and what limits their steps is not the error.
    settled = initial_steps >= LIMIT_RATIO * max_steps
    good, bad = np.where(settled, max_steps, 0.0), np.full(batches.size, np.inf)
    error = np.zeros(batches.size)
    change = np.ones(batches.size)
    for _ in range(0 if settled.all() else MAX_ROUNDS):
        # As many as ever are measured: in place of the settled the quickest, which costs least.
        places = np.where(settled, batches.size - 1, np.arange(batches.size))
        found = step_errors(peaks, batches[places], steps[places], map_function)
        error = np.where(settled, error, found)
        met = ~(error > tolerance)
        good = np.where(met, np.maximum(good, steps), good)
        bad = np.where(met, bad, np.minimum(bad, steps))
        with np.errstate(divide="ignore"):
            change = np.clip(
                (TARGET_ERROR * tolerance / error) ** (1 / CONVERGENCE_ORDER), 0.5, 1.5
            )
        # A step is long enough if the error says so, or a longer one was bad or makes no sense.
        limit_known = ~(error < tolerance * MIN_USEFUL_ERROR) | (bad < np.inf) | (good >= max_steps)
        settled = (good > 0) & limit_known
        if settled.all():
            break
        steps = np.where(settled, good, np.minimum(steps * change, max_steps))
    # What errors still allow is trusted: others are measured with the steps that come of it.
    extrapolation = np.where((good == steps) & (bad == np.inf), np.fmax(change, 1.0), 1.0)
    return good * extrapolation, ~np.isnan(error)


def _no_step_error(tolerance: float) -> RuntimeError:
    return RuntimeError(
        f"no time step makes the peaks agree to {tolerance:g}; the responses grow without "
        "bound, or the frequencies are too far apart: check stiffnesses, masses and damping, "
        "or keep fewer modes (beam.modes)"
    )
