"""Step sizes of the batches of a sweep, measured on a few of them and checked on others.

The longest step that meets a tolerance falls with the crossing rate of the loads, in a way that
depends on the model. It is measured at a few crossing rates; in between, the shorter of the two
adjacent steps is taken. The steps are then checked on a stratified sample of batches. Batches
outside the sample may have larger errors where the response changes sharply from run to run: the
error of a heavy mass near its critical speed is ten times that of a slightly slower one.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.case.case import Case, concrete_case, replace
from jaxbeam.case.fields import concrete
from jaxbeam.case.profiles.spectra import AbstractSpectralProfile
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.model.load_set import load_set
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled
from jaxbeam.runtime.vectorised import NotVectorisedError, vectorised
from jaxbeam.simulation.integrator.integrate import longest_force_step
from jaxbeam.simulation.integrator.time_grid import LoadEvents
from jaxbeam.simulation.sweeps.batches import Batches, values_at

CONVERGENCE_ORDER = 9  # assumed order of the error in the step; the true order is higher
REFINEMENT = 1.25  # ratio of a step to the finer step with which its error is measured
# Fraction of the allowed error to aim at for random profiles: errors of other runs are up to three
# times as large.
RANDOM_FRACTION = 0.4
WAVES_PER_STEP = 0.6  # initial step over the shortest wave of a profile, for errors of 1e-7
MAX_ROUNDS = 12
MEASURED_SAFETY = 2  # error stated / largest difference, where all runs are measured
LEAST_STATED_ERROR = 0.3  # relative to the tolerance, where steps were searched for it
SAFETY_FACTOR = 6  # tolerance / largest error allowed in the sample
TARGET_ERROR = 0.6  # aim of a longer step, relative to the error allowed
# Errors relative to the error allowed from which steps are extrapolated unmeasured: the sample
# checks them.
MIN_USEFUL_ERROR, MAX_USEFUL_ERROR = 3e-3, 10
LIMIT_RATIO = 1.3  # initial step / longest step from which on the longest is taken unmeasured
SAMPLE_DIVISOR = 4  # the sample grows with the square root of the number of batches over this
SMALL_TOLERANCE = 1e-10  # below it, rounding in double precision may exceed the tolerance
MOST_TRIALS = 4  # results kept of a batch: those of two pairs of runs
NEGLIGIBLE_PEAK = 1e-6  # relative to a run's largest peak; errors of smaller peaks refer to it

# Function from batch indices, steps (s) and extra steps per panel to peaks (path, batch, sensor).
PeaksFunction = Callable[
    [Int[np.ndarray, " path"], Float[np.ndarray, " path"], Int[np.ndarray, " path"]], np.ndarray
]


def initial_step_sizes(
    crossing_times: Float[np.ndarray, " path"],
    max_steps: Float[np.ndarray, " path"],
    modes: int,
    tolerance: float,
) -> Float[np.ndarray, " path"]:
    """Initial steps (s) of batches, from crossing times (s) and longest stable steps (s).

    A fit to beams of one and two spans with 1 to 12 modes at slow and fast crossings, for errors of
    1e-7, scaled with CONVERGENCE_ORDER.
    """
    steps = crossing_times / (20 * modes + 1.84 * crossing_times / max_steps / np.sqrt(modes))
    return steps * (tolerance / 1e-7) ** (1 / CONVERGENCE_ORDER)


def initial_fraction(quantities: Iterable[str]) -> float:
    """Factor on the initial steps for the measured quantities: 1 for deflections, less for others.

    Higher modes dominate their errors. For beams of one and two spans with 2 to 12 modes the median
    factors are 0.9 for moments, 0.65 for shear forces, 0.25 for accelerations.
    """
    in_x, in_time = (1.0, 0.9, 0.9, 0.65), (1.0, 0.45, 0.25)
    found = (QUANTITIES[name] for name in quantities)
    return min((in_x[q.x_derivative] * in_time[q.time_derivative] for q in found), default=1.0)


def log_spaced_sample(
    crossing_rates: Float[np.ndarray, " path"], masses: Float[np.ndarray, " path"], count: int
) -> Int[np.ndarray, " sample"]:
    """Indices of `count` batches: the heaviest near each of evenly spaced log crossing rates.

    Errors grow with the masses of loads. Among equal masses the nearest batch is chosen; then the
    fastest is in the sample, the slowest are not: they take longest, and their errors differ most
    from those of others. An index may occur twice.
    """
    order = np.argsort(crossing_rates, kind="stable")
    logs = np.log(crossing_rates[order])
    targets = np.linspace(logs[0] + (logs[-1] - logs[0]) / (2 * count), logs[-1], count)
    if logs[-1] - logs[0] < 1e-9:
        return order[np.linspace(0, order.size - 1, count).astype(int)]
    distances = np.abs(logs[:, None] - targets)
    near = distances <= distances.min(axis=1, keepdims=True)
    near[distances.argmin(axis=0), np.arange(count)] = True  # one at least
    heaviest = np.where(near, masses[order, None], -np.inf)
    heaviest = near & (heaviest >= heaviest.max(axis=0))
    return order[np.where(heaviest, distances, np.inf).argmin(axis=0)]


def step_errors(
    peaks: PeaksFunction, batches, steps, extra_steps: Int[np.ndarray, " path"] | int = 0
) -> Float[np.ndarray, " path"]:
    """Largest relative change of the peaks of each batch with steps REFINEMENT times finer.

    The finer runs have one more of the `extra_steps` per panel, as few steps would not change
    otherwise. Runs that fail are left out; NaN if all do.
    """
    # The finer runs take longer: each half has the finer runs of every other batch.
    fine_first = np.arange(len(batches)) % 2 == 0
    is_fine = np.append(fine_first, ~fine_first)
    both_steps = np.tile(steps, 2) / np.where(is_fine, REFINEMENT, 1.0)
    both_extra = np.tile(np.broadcast_to(extra_steps, len(batches)), 2) + is_fine
    halves = np.split(peaks(np.tile(batches, 2), both_steps, both_extra), 2)
    fine, coarse = (np.where(fine_first[:, None, None], *pair) for pair in (halves, halves[::-1]))
    return relative_changes(coarse, fine)


def rounding_error(exact: Float[np.ndarray, "path batch sensor"], rounded: np.ndarray) -> float:
    """Largest relative error of peaks in single precision, over the runs that do not fail."""
    return largest_error(relative_changes(rounded, exact))


def largest_error(errors: Sequence[float] | np.ndarray) -> float:
    """Largest error that is not NaN; NaN if all are, as where all runs fail."""
    return float(np.fmax.reduce(np.asarray(errors, float), initial=np.nan))


def stratified_sample(
    crossing_rates: Float[np.ndarray, " path"], count: int
) -> Int[np.ndarray, " sample"]:
    """Indices of `count` batches, one at random from each of `count` quantiles of crossing rates.

    The random numbers are the same each time. An index may occur twice.
    """
    quantiles = (
        (np.arange(count) + np.random.default_rng(0).random(count)) * crossing_rates.size / count
    )
    return np.argsort(crossing_rates, kind="stable")[quantiles.astype(int)]


def _interpolate_conservatively(
    crossing_rates: Float[np.ndarray, " path"],
    sampled_rates: Float[np.ndarray, " sample"],
    values: Float[np.ndarray, " sample"],
) -> Float[np.ndarray, " path"]:
    """Smaller of the values at the two adjacent sampled rates; the end value beyond them."""
    unique, group = np.unique(sampled_rates, return_inverse=True)
    smallest = np.full(unique.size, np.inf)
    np.minimum.at(smallest, group, values)
    above = np.searchsorted(unique, crossing_rates, side="left")
    below = np.searchsorted(unique, crossing_rates, side="right") - 1
    return np.minimum(*(smallest[np.clip(side, 0, unique.size - 1)] for side in (below, above)))


def relative_changes(coarse, fine):
    """Largest relative change of peaks in each batch; NaN where all runs fail."""
    finite = np.isfinite(fine)
    size = np.abs(np.where(finite, fine, 0.0))
    size = np.maximum(size, NEGLIGIBLE_PEAK * size.max(axis=-1, keepdims=True))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        change = np.abs(coarse - fine) / size
    change = np.where(np.isfinite(coarse), change, np.inf)
    change = np.where(finite & (size > 0), change, 0.0).max(axis=(1, 2), initial=0.0)
    return np.where(finite.any(axis=(1, 2)), change, np.nan)


def choose_step_sizes(
    peaks: PeaksFunction,
    crossing_rates: Float[np.ndarray, " path"],
    masses: Float[np.ndarray, " path"],
    initial_steps: Float[np.ndarray, " path"],
    max_steps: Float[np.ndarray, " path"],
    count: int,
    tolerance: float,
    all_measured: bool = False,
    few_peaks: PeaksFunction | None = None,
    search_fraction: float = 1.0,
) -> tuple[Float[np.ndarray, " path"], Int[np.ndarray, " path"], float]:
    """Longest steps (s) of all batches for a tolerance, extra steps, and the stated error.

    The stated error is SAFETY_FACTOR times the largest of the sample: in random sweeps of beams of
    one and two spans and all quantities, 0.02 % of the runs had larger true errors, at most twice.

    The search over `crossing_rates` (1/s), among the batches of the largest `masses` (kg), starts
    from `initial_steps` (s) and is limited by `max_steps` (s); it takes `few_peaks`, the peaks of
    few runs of the batches, if they are given, and aims at `search_fraction` of the allowed error.
    The steps are then checked on a stratified sample, or the errors of all batches are measured
    (`_measured_steps`). Raises RuntimeError if no step meets the tolerance. The error is NaN if all
    runs fail.
    """
    target_error = tolerance / (MEASURED_SAFETY if all_measured else SAFETY_FACTOR)
    chosen = log_spaced_sample(crossing_rates, masses, count)
    valid_steps, succeeds = _search_step_sizes(
        few_peaks or peaks,
        chosen,
        initial_steps[chosen],
        max_steps[chosen],
        search_fraction * target_error,
    )
    if not np.all(valid_steps > 0):
        raise _no_step_error(tolerance)
    nothing = np.zeros(crossing_rates.size, int)
    if not succeeds.any():
        return np.minimum(initial_steps, max_steps), nothing, np.nan
    chosen, valid_steps = chosen[succeeds], valid_steps[succeeds]
    start = np.minimum(initial_steps, max_steps)
    step_ratio = _interpolate_conservatively(
        crossing_rates, crossing_rates[chosen], valid_steps / start[chosen]
    )  # to the initial step
    steps = np.minimum(start * step_ratio, max_steps)
    if all_measured:
        return _measured_steps(peaks, steps, max_steps, tolerance)
    groups = max(1, round(np.sqrt(crossing_rates.size / count) / SAMPLE_DIVISOR))
    sample = stratified_sample(crossing_rates, count * groups)
    error, fails = np.full(sample.size, np.nan), np.ones(sample.size, bool)
    for _ in range(MAX_ROUNDS):
        found = step_errors(peaks, sample[fails], steps[sample[fails]])
        error[fails] = found
        fails, measured = error > target_error, ~np.isnan(error)  # NaN: no run succeeds
        if not fails.any():
            return steps, nothing, SAFETY_FACTOR * largest_error(error)
        with np.errstate(divide="ignore"):
            factor = np.maximum(0.7, 0.92 * (target_error / error) ** (1 / CONVERGENCE_ORDER))
        # Only up to the next batches of the sample, whose steps are short enough.
        factor = np.where(fails, factor, 1.0)
        steps = steps * _interpolate_conservatively(
            crossing_rates, crossing_rates[sample[measured]], factor[measured]
        )
    raise _no_step_error(tolerance)


def _measured_steps(
    peaks: PeaksFunction,
    steps: Float[np.ndarray, " path"],
    max_steps: Float[np.ndarray, " path"],
    tolerance: float,
) -> tuple[Float[np.ndarray, " path"], Int[np.ndarray, " path"], float]:
    """Steps (s) of batches from errors measured in all of them, extra steps, and the stated error.

    Each batch is run with two steps, whose peaks may differ by half the tolerance; the finer run is
    its result. In 288 runs of trucks and quarter cars over random profiles the error of the finer
    run was a quarter of the difference in the median (REFINEMENT**-CONVERGENCE_ORDER predicts a
    sixth), and 2.6 times it at most where the difference is more than rounding. The stated error is
    MEASURED_SAFETY times the largest difference, and, as two peaks may agree by chance, no less
    than LEAST_STATED_ERROR of the tolerance, unless the longest steps meet it. Where runs differ by
    more, the finer one becomes the coarser of the next pair, unless it is still much too coarse.
    """
    allowed = tolerance / MEASURED_SAFETY
    steps, extra = steps.copy(), np.zeros(steps.size, int)
    error, left = np.full(steps.size, np.nan), np.arange(steps.size)
    for _ in range(MAX_ROUNDS):
        found = step_errors(peaks, left, steps[left], extra[left])
        error[left] = found
        left = left[found > allowed]
        if not left.size:
            searched = np.any((steps < max_steps) & ~np.isnan(error))
            least = LEAST_STATED_ERROR * tolerance * searched
            stated = max(MEASURED_SAFETY * largest_error(error), least)
            return steps / REFINEMENT, extra + 1, stated
        with np.errstate(divide="ignore"):
            factor = np.maximum(0.3, 0.92 * (allowed / error[left]) ** (1 / CONVERGENCE_ORDER))
        is_near = factor > REFINEMENT**-2
        steps[left] = np.where(is_near, steps[left] / REFINEMENT, steps[left] * factor)
        extra[left] += is_near
    raise _no_step_error(tolerance)


def _search_step_sizes(
    peaks: PeaksFunction,
    batches,
    initial_steps,
    max_steps,
    tolerance: float,
):
    """Longest steps (s) of batches that meet a tolerance, or 0; and whether any run succeeds.

    Batches are in the order of their crossing rates.
    """
    steps = np.minimum(initial_steps, max_steps)
    # Slow crossings take longest, and stability limits their steps, not the error.
    settled = initial_steps >= LIMIT_RATIO * max_steps
    longest_valid, shortest_invalid = (
        np.where(settled, max_steps, 0.0),
        np.full(batches.size, np.inf),
    )
    error = np.zeros(batches.size)
    step_factor = np.ones(batches.size)
    for _ in range(0 if settled.all() else MAX_ROUNDS):
        left = ~settled
        error[left] = step_errors(peaks, batches[left], steps[left])
        with np.errstate(divide="ignore"):
            step_factor = np.clip(
                (TARGET_ERROR * tolerance / error) ** (1 / CONVERGENCE_ORDER), 0.5, 1.5
            )
        meets_tolerance = ~(error > tolerance)
        is_useful = ~(error > tolerance * MAX_USEFUL_ERROR)
        valid = steps * np.where(meets_tolerance, 1.0, is_useful * step_factor)
        longest_valid = np.maximum(longest_valid, valid)
        shortest_invalid = np.where(
            meets_tolerance, shortest_invalid, np.minimum(shortest_invalid, steps)
        )
        # A step is settled if its error is useful, a longer one fails, or it is the longest.
        limit_known = (
            ~(error < tolerance * MIN_USEFUL_ERROR)
            | (shortest_invalid < np.inf)
            | (longest_valid >= max_steps)
        )
        settled = (longest_valid > 0) & limit_known
        if settled.all():
            break
        steps = np.where(settled, longest_valid, np.minimum(steps * step_factor, max_steps))
    # The last extrapolation is not measured here; the sample checks it.
    extrapolation = np.where(
        (longest_valid == steps) & (shortest_invalid == np.inf), np.fmax(step_factor, 1.0), 1.0
    )
    return longest_valid * extrapolation, ~np.isnan(error)


def _no_step_error(tolerance: float) -> RuntimeError:
    rounding = "; rounding is larger, or " if tolerance < SMALL_TOLERANCE else "; "
    return RuntimeError(
        f"no time step makes the peaks agree to {tolerance:g}{rounding}the responses are unstable, "
        "or the frequencies are too far apart: give a larger tolerance, check stiffnesses, masses "
        "and damping, or keep fewer modes (beam.modes)"
    )


class Trials:
    """Latest results of batches by name, by their steps (s) and extra steps in each panel.

    Trial runs with the final steps are results of the sweep: 4 of the 64 batches of 4096 crossings,
    and all batches of sweeps of few. The latest runs of each batch are kept, as pairs of them are
    compared.
    """

    def __init__(self):
        self._latest: dict[int, dict[tuple[float, int], dict[str, np.ndarray]]] = {}

    def add(
        self,
        batch_indices: Int[np.ndarray, " path"],
        steps: Float[np.ndarray, " path"],
        extra_steps: Int[np.ndarray, " path"],
        results: dict[str, np.ndarray],
    ) -> None:
        """Keep the results (path, batch, ...) of batches."""
        for row, key in enumerate(zip(steps.tolist(), extra_steps.tolist(), strict=True)):
            kept = self._latest.setdefault(int(batch_indices[row]), {})
            kept.pop(key, None)
            kept[key] = {name: part[row] for name, part in results.items()}
            while len(kept) > MOST_TRIALS:
                kept.pop(next(iter(kept)))

    def has_results(
        self,
        batch_indices: Int[np.ndarray, " path"],
        steps: Float[np.ndarray, " path"],
        extra_steps: Int[np.ndarray, " path"],
    ) -> Bool[np.ndarray, " path"]:
        """Whether results of the batches are kept for the given steps."""
        rows = zip(*(part.tolist() for part in (batch_indices, steps, extra_steps)), strict=True)
        return np.array([(step, more) in self._latest.get(i, {}) for i, step, more in rows], bool)

    def completed(
        self,
        results: dict[str, np.ndarray],
        batch_indices: Int[np.ndarray, " path"],
        steps: Float[np.ndarray, " path"],
        extra_steps: Int[np.ndarray, " path"],
        is_stored: Bool[np.ndarray, " path"],
    ) -> dict[str, np.ndarray]:
        """Results (path, batch, ...) of batches, completed by kept results of stored batches."""
        stored = {
            row: self._latest[int(batch_indices[row])][float(steps[row]), int(extra_steps[row])]
            for row in np.flatnonzero(is_stored)
        }
        if is_stored.all():
            return {name: np.stack([one[name] for one in stored.values()]) for name in stored[0]}
        results = {name: np.array(values) for name, values in results.items()}
        for row, of_batch in stored.items():
            for name, values in of_batch.items():
                results[name][row] = values
        return results


# `LoadEvents` of all paths, of concrete numbers.
PathEvents = tuple[Float[np.ndarray, "path wheel 2"], Float[np.ndarray, "path event"]]


class PathTimes(NamedTuple):
    """Load events (s) of paths, and the longest steps (s) that resolve their forces."""

    load_events: LoadEvents
    force_steps: Array


def path_times(case, addresses, shared_values, places) -> PathTimes:
    """Load events of all paths, including wheels that pass some places (m); longest force steps.

    Compiled only where vectorising fails, as with values of tables of positions.
    """
    concrete_numbers = concrete_case(case)
    try:
        with np.errstate(all="ignore"):  # as in compiled code
            return vectorised(lambda values: _times(concrete_numbers, addresses, values, places))(
                shared_values
            )
    except NotVectorisedError:
        return _compiled_times(case, addresses, shared_values, places)


def _times(case, addresses, values, places) -> PathTimes:
    varied = replace(case, dict(zip(addresses, values, strict=True)))
    loads = load_set(varied)
    return PathTimes(loads.events(places), longest_force_step(varied, loads))


@compiled
def _compiled_times(case, addresses, shared_values, places) -> PathTimes:
    return jax.vmap(lambda values: _times(case, addresses, values, places))(shared_values)


class StepLimits(NamedTuple):
    """Crossing rates (1/s), initial steps and longest steps (s) of batches."""

    crossing_rates: Float[np.ndarray, " path"]
    initial_steps: Float[np.ndarray, " path"]
    max_steps: Float[np.ndarray, " path"]


def step_limits(
    case: Case,
    batches: Batches,
    times: PathTimes,
    stable_steps: Float[np.ndarray, " path"],
    longest: float | None,
    tolerance: float,
) -> StepLimits:
    """Crossing rates and limits of the steps of batches.

    `stable_steps` (s) are the longest stable steps, infinite where there is none.

    No step is longer than `longest` (s), if it is given.
    """
    entries, exits = np.moveaxis(np.asarray(times.load_events[0]), 2, 0)
    duration = values_at(case, batches, "run.duration")
    times_on_beam = np.minimum(exits, duration[:, None]) - entries
    times_on_beam = np.where(times_on_beam > 0, times_on_beam, duration[:, None])
    crossing_time = np.min(times_on_beam, axis=1, initial=np.inf)
    crossing_time = np.where(np.isfinite(crossing_time), crossing_time, duration)
    limits = np.minimum(stable_steps, times.force_steps)
    max_steps = np.minimum(limits, duration)
    if longest is not None:
        max_steps = np.minimum(max_steps, longest)
    initial = initial_step_sizes(crossing_time, limits, case.beam.modes, tolerance)
    initial = initial * initial_fraction(sensor.quantity for sensor in case.sensors)
    if isinstance(case.profile, AbstractSpectralProfile):
        shortest = 1 / np.max(concrete(case.profile.lines()[0]))
        of_wave = WAVES_PER_STEP * shortest / float(concrete(case.beam.length)) * crossing_time
        initial = np.minimum(initial, of_wave * (tolerance / 1e-7) ** (1 / CONVERGENCE_ORDER))
    return StepLimits(1 / crossing_time, initial, max_steps)
