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

ORDER = 9  # at which errors are taken to fall with the step; the true order is higher
FINER = 1.25  # how much finer the runs are with which others are compared
ROUNDS = 12
MARGIN = 6  # how much smaller errors must be where they are looked for than they may be elsewhere
AIMED = 0.6  # of the error allowed: what longer steps aim at
TIGHT = 3e-3  # of the error allowed: with less, longer steps are measured before they are trusted
SURE = 1.3  # how far a guess must exceed the limit of a step for that to be taken unmeasured
TRIED = 4  # those tried grow with the root of the number of tasks, divided by this
SMALL = 1e-6  # of a run's largest peak: smaller ones need not be right to the tolerance

# Of tasks, their steps (s), and how many steps more between events.
Measure = Callable[[Int[np.ndarray, " task"], Float[np.ndarray, " task"], int], np.ndarray]


def spread(paces: Float[np.ndarray, " task"], count: int) -> Int[np.ndarray, " chosen"]:
    """`count` tasks (some maybe twice) from slow ones to the fastest, evenly in log pace.

    The slowest of all are left out: they take longest, and their errors tell least of the others.
    """
    order = np.argsort(paces, kind="stable")
    logs = np.log(paces[order])
    wanted = np.linspace(logs[0] + (logs[-1] - logs[0]) / (2 * count), logs[-1], count)
    if logs[-1] - logs[0] < 1e-9:
        return order[np.linspace(0, order.size - 1, count).astype(int)]
    return order[np.abs(logs[:, None] - wanted).argmin(axis=0)]


def errors(measure: Measure, tasks, steps, each=map) -> Float[np.ndarray, " task"]:
    """How much the peaks of tasks, (task, lane, sensor), change with finer steps than these (s).

    The largest relative change in each task. Runs that fail are left out; NaN if all do. Finer is
    one step more between events at least, or between samples of a loop: there may be few of them.
    `each` calls a function as `map` does, maybe side by side.
    """
    # The finer take longer, and go first.
    fine, coarse = each(measure, (tasks, tasks), (steps / FINER, steps), (1, 0))
    return _changes(coarse, fine)


def rounding(exact: Float[np.ndarray, "task lane sensor"], rounded: np.ndarray) -> float:
    """The largest relative error of peaks computed with rounded numbers, where any run works."""
    return float(np.nanmax(_changes(rounded, exact), initial=0.0))


def drawn(paces: Float[np.ndarray, " task"], count: int) -> Int[np.ndarray, " chosen"]:
    """`count` tasks (some maybe twice), one from each of as many equal parts of all, by pace.

    At random within these parts, and the same each time.
    """
    places = (np.arange(count) + np.random.default_rng(0).random(count)) * paces.size / count
    return np.argsort(paces, kind="stable")[places.astype(int)]


def _between(
    paces: Float[np.ndarray, " task"],
    known: Float[np.ndarray, " chosen"],
    values: Float[np.ndarray, " chosen"],
) -> Float[np.ndarray, " task"]:
    """The smaller of the values at the known paces next to each; beyond them, that at the end."""
    unique, which = np.unique(known, return_inverse=True)
    least = np.full(unique.size, np.inf)
    np.minimum.at(least, which, values)
    above = np.searchsorted(unique, paces, side="left")
    below = np.searchsorted(unique, paces, side="right") - 1
    return np.minimum(*(least[np.clip(side, 0, unique.size - 1)] for side in (below, above)))


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
    each: Callable = map,
) -> tuple[Float[np.ndarray, " task"], float]:
    """Longest steps (s) of all tasks for a tolerance, and the error seen on a random few.

    `measure` takes tasks, a multiple of `count`, their steps and how many more between events, and
    returns their peaks; `each` calls it several times, as `map` does. `paces` (1/s) order the
    tasks, `guesses` start the search, `limits` (s) cap it. Raises RuntimeError if no step meets the
    tolerance.
    """
    aim = tolerance / MARGIN
    chosen = spread(paces, count)
    good, works = _search(measure, chosen, guesses[chosen], limits[chosen], aim, each)
    if not np.all(good > 0):
        raise _hopeless(tolerance)
    if not works.any():
        return np.minimum(guesses, limits), 0.0
    chosen, good = chosen[works], good[works]
    start = np.minimum(guesses, limits)
    longer = _between(paces, paces[chosen], good / start[chosen])  # than guessed
    steps = np.minimum(start * longer, limits)
    some = drawn(paces, count * max(1, round(np.sqrt(paces.size / count) / TRIED)))
    for _ in range(ROUNDS):
        error = errors(measure, some, steps[some], each)
        worst = float(np.max(np.where(np.isnan(error), 0.0, error)))
        if worst <= aim:
            return steps, worst
        with np.errstate(divide="ignore"):
            steps = steps * max(0.7, 0.95 * (aim / worst) ** (1 / ORDER))
    raise _hopeless(tolerance)


def _search(measure: Measure, tasks, guesses, limits, tolerance: float, each: Callable):
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
        found = errors(measure, tasks[places], steps[places], each)
        error = np.where(settled, error, found)
        met = ~(error > tolerance)
        good = np.where(met, np.maximum(good, steps), good)
        bad = np.where(met, bad, np.minimum(bad, steps))
        with np.errstate(divide="ignore"):
            change = np.clip((AIMED * tolerance / error) ** (1 / ORDER), 0.5, 1.5)
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
