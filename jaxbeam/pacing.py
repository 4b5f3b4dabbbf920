"""Time steps for many runs: measured on a few of them, checked on others.

The longest step that meets a tolerance shrinks with the pace of the loads, at a rate that depends
on the rig; it is measured at a few paces and interpolated. What was measured is then tried on
runs drawn at random.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Int

ORDER = 9  # at which errors are taken to fall with the step; the true order is higher
FINER = 1.25  # how much finer the runs are with which others are compared
ROUNDS = 12
MARGIN = 4  # how much smaller errors must be where they are looked for than they may be elsewhere
TIGHT = 3e-3  # of the error allowed: with less, longer steps are measured before they are trusted
SURE = 1.3  # how far a guess must exceed the limit of a step for that to be taken unmeasured
SMALL = 1e-6  # of a run's largest peak: smaller ones need not be right to the tolerance

# Of tasks, their steps (s), and how many steps more between events.
Measure = Callable[[Int[np.ndarray, " task"], Float[np.ndarray, " task"], int], np.ndarray]


def spread(paces: Float[np.ndarray, " task"], count: int) -> Int[np.ndarray, " chosen"]:
    """`count` tasks (some maybe twice) from the slowest to the fastest, evenly in log pace."""
    order = np.argsort(paces, kind="stable")
    logs = np.log(paces[order])
    wanted = np.linspace(logs[0], logs[-1], count)
    if logs[-1] - logs[0] < 1e-9:
        return order[np.linspace(0, order.size - 1, count).astype(int)]
    return order[np.abs(logs[:, None] - wanted).argmin(axis=0)]


def errors(measure: Measure, tasks, steps) -> Float[np.ndarray, " task"]:
    """How much the peaks of tasks, (task, lane, sensor), change with finer steps than these (s).

    The largest relative change in each task. Runs that fail are left out; NaN if all do. Finer is
    one step more between events at least, or between samples of a loop: there may be few of them.
    """
    with ThreadPoolExecutor(2) as pool:
        coarse, fine = pool.map(measure, (tasks, tasks), (steps, steps / FINER), (0, 1))
    return _changes(coarse, fine)


def rounding(exact: Float[np.ndarray, "task lane sensor"], rounded: np.ndarray) -> float:
    """The largest relative error of peaks computed with rounded numbers, where any run works."""
    return float(np.nanmax(_changes(rounded, exact), initial=0.0))


def drawn(tasks: int, count: int) -> Int[np.ndarray, " chosen"]:
    """`count` of so many tasks (some maybe twice), at random and the same each time."""
    return np.resize(np.random.default_rng(0).permutation(tasks), count)


def _changes(coarse, fine):
    """The largest relative change of peaks in each task; NaN where no run works."""
    works = np.isfinite(fine)
    size = np.abs(np.where(works, fine, 0.0))
    size = np.maximum(size, SMALL * size.max(axis=-1, keepdims=True))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        change = np.abs(coarse - fine) / size
    change = np.where(np.isfinite(coarse), change, np.inf)
    change = np.where(works & (size > 0), change, 0.0).max(axis=(1, 2), initial=0.0)
    return np.where(works.any(axis=(1, 2)), change, np.nan)


def choose_steps(
    measure: Measure,
    paces: Float[np.ndarray, " task"],
    guesses: Float[np.ndarray, " task"],
    limits: Float[np.ndarray, " task"],
    count: int,
    tolerance: float,
) -> tuple[Float[np.ndarray, " task"], float]:
    """Longest steps (s) of all tasks for a tolerance, and the error seen on a random few.

    `measure` takes `count` tasks, their steps and how many more between events, and returns their
    peaks. `paces` (1/s) order the
    tasks, `guesses` start the search, `limits` (s) cap it. Raises RuntimeError if no step meets
    the tolerance.
    """
    aim = tolerance / MARGIN
    chosen = spread(paces, count)
    good, works = _search(measure, chosen, guesses[chosen], limits[chosen], aim)
    if not np.all(good > 0):
        raise _hopeless(tolerance)
    if not works.any():
        return np.minimum(guesses, limits), 0.0
    chosen, good = chosen[works], good[works]
    # How much longer than guessed, by pace; of tasks with one pace, the least counts.
    start = np.minimum(guesses, limits)
    unique, which = np.unique(np.log(paces[chosen]), return_inverse=True)
    lowest = np.full(unique.size, np.inf)
    np.minimum.at(lowest, which, np.log(good / start[chosen]))
    longer = np.exp(np.interp(np.log(paces), unique, lowest))
    steps = np.minimum(start * longer, limits)
    some = drawn(paces.size, count)
    for _ in range(ROUNDS):
        error = errors(measure, some, steps[some])
        worst = float(np.max(np.where(np.isnan(error), 0.0, error)))
        if worst <= aim:
            return steps, worst
        with np.errstate(divide="ignore"):
            steps = steps * max(0.7, 0.95 * (aim / worst) ** (1 / ORDER))
    raise _hopeless(tolerance)


def _search(measure: Measure, tasks, guesses, limits, tolerance: float):
    """Long good steps (s) of some tasks, 0 if none was; which of these have a run that works.

    Tasks go from slow to quick.
    """
    steps = np.minimum(guesses, limits)
    # Slow tasks take longest, and what limits their steps is not the error.
    settled = guesses >= SURE * limits
    good, bad = np.where(settled, limits, 0.0), np.full(tasks.size, np.inf)
    error = np.zeros(tasks.size)
    change = np.ones(tasks.size)
    for _ in range(0 if settled.all() else ROUNDS):
        # As many as ever are measured: in place of the settled the quickest, which costs least.
        places = np.where(settled, tasks.size - 1, np.arange(tasks.size))
        found = errors(measure, tasks[places], steps[places])
        error = np.where(settled, error, found)
        met = ~(error > tolerance)
        good = np.where(met, np.maximum(good, steps), good)
        bad = np.where(met, bad, np.minimum(bad, steps))
        with np.errstate(divide="ignore"):
            change = np.clip((0.3 * tolerance / error) ** (1 / ORDER), 0.5, 1.5)
        # A step is long enough if the error says so, or a longer one was bad or makes no sense.
        tight = ~(error < tolerance * TIGHT) | (bad < np.inf) | (good >= limits)
        settled = (good > 0) & tight
        if settled.all():
            break
        steps = np.where(settled, good, np.minimum(steps * change, limits))
    # What errors still allow is trusted: others are measured with the steps that come of it.
    longer = np.where((good == steps) & (bad == np.inf), np.fmax(change, 1.0), 1.0)
    return good * longer, ~np.isnan(error)


def _hopeless(tolerance: float) -> RuntimeError:
    return RuntimeError(
        f"no time step makes the peaks agree to {tolerance:g}; the responses grow without "
        "bound, or the frequencies are too far apart: check stiffnesses, masses and damping, "
        "or keep fewer modes (beam.modes)"
    )
