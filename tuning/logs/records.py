"""Evenly sampled records of a log: split at gaps, resampled where the clock wanders."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.logs.log import GAP_STEPS, MAX_GRID_DEVIATION_STEPS, Log

MIN_RECORD_SAMPLES = 64


class EvenRecord(NamedTuple):
    """Samples at even steps: the time of the first (s), and the values (time, channel)."""

    start: float
    values: Float[np.ndarray, "time channel"]


def even_records(log: Log) -> tuple[float, tuple[EvenRecord, ...], tuple[str, ...]]:
    """Sampling rate (Hz), the records of a log between its gaps, and notes on what was done.

    All records have one rate, that of the usual step. Times off an even grid by more than rounding
    are interpolated (cubic spline) to the grid.

    Raises ValueError for a log whose records between gaps are all too short.
    """
    step, parts = between_gaps(log.times)
    records, notes, resampled, dropped = [], [], 0.0, 0
    for start, stop in parts:
        if stop - start < MIN_RECORD_SAMPLES:
            dropped += 1
            continue
        times, values = log.times[start:stop], log.values[start:stop]
        grid = times[0] + step * np.arange(round((times[-1] - times[0]) / step) + 1)
        count = min(grid.size, times.size)
        deviation = np.max(np.abs(times[:count] - grid[:count])) / step
        if grid.size != times.size or deviation > MAX_GRID_DEVIATION_STEPS:
            from scipy.interpolate import CubicSpline

            grid = grid[grid <= times[-1]]
            values = CubicSpline(times, values, axis=0)(grid)
            resampled = max(resampled, float(deviation))
        records.append(EvenRecord(float(times[0]), values))
    if not records:
        raise ValueError(
            f"{log.source}: after {len(parts) - 1} gaps no record has {MIN_RECORD_SAMPLES} samples"
        )
    if len(parts) > 1:
        used = "1 record is used" if len(records) == 1 else f"{len(records)} records are used"
        less = f", {dropped} of less than {MIN_RECORD_SAMPLES} samples left out" if dropped else ""
        many = "1 gap" if len(parts) == 2 else f"{len(parts) - 1} gaps"
        notes.append(f"{many}: {used}{less}")
    if resampled:
        notes.append(
            f"times are up to {resampled:.2g} steps off an even grid of {step:.6g} s: interpolated"
        )
    return 1 / step, tuple(records), tuple(notes)


def between_gaps(times: Float[np.ndarray, " time"]) -> tuple[float, list[tuple[int, int]]]:
    """Step (s) of some times, and the first and last (exclusive) sample of each part without gap.

    >>> import numpy as np
    >>> from tuning.logs.records import between_gaps
    >>> between_gaps(np.array([0.0, 1.0, 2.0, 7.0, 8.0]))
    (1.0, [(0, 3), (3, 5)])
    """
    steps = np.diff(times)
    usual = np.median(steps)
    # The median of rounded steps is one of the rounded steps; their mean without gaps is not.
    cuts = np.flatnonzero(steps > GAP_STEPS * usual) + 1
    within = np.delete(steps, cuts - 1)
    step = float(np.mean(within)) if within.size else float(usual)
    edges = [0, *cuts.tolist(), times.size]
    return step, list(zip(edges[:-1], edges[1:], strict=True))
