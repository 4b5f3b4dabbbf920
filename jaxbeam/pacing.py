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
FINER = 1.5  # how much finer the runs are with which others are compared
ROUNDS = 30

Measure = Callable[[Int[np.ndarray, " task"], Float[np.ndarray, " task"]], np.ndarray]


def spread(paces: Float[np.ndarray, " task"], count: int) -> Int[np.ndarray, " chosen"]:
    """`count` tasks (some maybe twice) from the slowest to the fastest, evenly in log pace."""
    order = np.argsort(paces, kind="stable")
    logs = np.log(paces[order])
    wanted = np.linspace(logs[0], logs[-1], count)
    if logs[-1] - logs[0] < 1e-9:
        return order[np.linspace(0, order.size - 1, count).astype(int)]
    return order[np.abs(logs[:, None] - wanted).argmin(axis=0)]


def errors(measure: Measure, tasks, steps) -> Float[np.ndarray, " task"]:
    """How much the results of tasks, (task, ...), change with finer steps than these (s).

    Relative; runs that fail at any step count as exact.
    """
    with ThreadPoolExecutor(2) as pool:
        coarse, fine = pool.map(measure, (tasks, tasks), (steps, steps / FINER))
    size = np.abs(fine)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        change = np.abs(coarse - fine) / size
    change = np.where(np.isfinite(fine), np.where(np.isfinite(coarse), change, np.inf), 0.0)
    change = np.where(size > 0, change, 0.0)
    return np.max(change.reshape(len(tasks), -1), axis=1, initial=0.0)


def choose_steps(
    measure: Measure,
    paces: Float[np.ndarray, " task"],
    guesses: Float[np.ndarray, " task"],
    limits: Float[np.ndarray, " task"],
    count: int,
    tolerance: float,
) -> tuple[Float[np.ndarray, " task"], float]:
    """Longest steps (s) of all tasks for a tolerance, and the error seen on a random few.

    `measure` takes `count` tasks and their steps and returns their peaks. `paces` (1/s) order the
    tasks, `guesses` start the search, `limits` (s) cap it. Raises RuntimeError if no step down
    to a millionth of the limits meets the tolerance.
    """
    chosen = spread(paces, count)
    steps = np.minimum(guesses[chosen], limits[chosen])
    good = np.zeros(count)
    for _ in range(ROUNDS):
        error = errors(measure, chosen, steps)
        met = error <= tolerance
        good = np.where(met, np.maximum(good, steps), good)
        tight = (error > tolerance * 1e-2) | (steps >= limits[chosen])
        if np.all(met & tight):
            break
        with np.errstate(divide="ignore"):
            change = (0.3 * tolerance / error) ** (1 / ORDER)
        change = np.where(np.isfinite(error), np.clip(change, 0.5, 1.5), 0.5)
        # A step that has been good is not lengthened again after a longer one failed.
        change = np.where(met & tight, 1.0, change)
        steps = np.minimum(np.where(met | (good == 0), steps * change, good), limits[chosen])
        if np.all(good > 0) and np.all(steps <= good):
            break
    if np.any(good < limits[chosen] * 1e-6):
        raise RuntimeError(
            f"no time step makes the peaks agree to {tolerance:g}; the responses grow without "
            "bound, or the frequencies are too far apart: check stiffnesses, masses and damping, "
            "or keep fewer modes (beam.modes)"
        )
    order = np.argsort(paces[chosen], kind="stable")
    # Of tasks with one pace, the shortest step counts.
    log_pace, log_step = np.log(paces[chosen][order]), np.log(good[order])
    unique = np.unique(log_pace)
    lowest = np.array([log_step[log_pace == pace].min() for pace in unique])
    steps = np.exp(np.interp(np.log(paces), unique, lowest))
    some = np.random.default_rng(0).integers(0, paces.size, count)
    while True:
        steps = np.minimum(steps, limits)
        error = float(np.max(errors(measure, some, steps[some])))
        if error <= tolerance:
            return steps, error
        steps = steps * 0.7
