"""Evenly sampled records of a log: split at gaps, resampled where the clock wanders."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.logs.log import MAX_GRID_DEVIATION_STEPS, Log
from tuning.logs.quality import GAP_STEPS

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
    steps = np.diff(log.times)
    usual = np.median(steps)
    # The median of rounded steps is one of the rounded steps; their mean without gaps is not.
    cuts = np.flatnonzero(steps > GAP_STEPS * usual) + 1
    within = np.delete(steps, cuts - 1)
    step = float(np.mean(within)) if within.size else float(usual)
    edges = [0, *cuts.tolist(), log.times.size]
    records, notes, resampled, dropped = [], [], 0.0, 0
    for start, stop in zip(edges[:-1], edges[1:], strict=True):
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
            f"{log.source}: after {len(cuts)} gaps no record has {MIN_RECORD_SAMPLES} samples"
        )
    if cuts.size:
        notes.append(
            f"{cuts.size} gaps: {len(records)} records between them are used together"
            + (f", {dropped} of less than {MIN_RECORD_SAMPLES} samples are not" if dropped else "")
        )
    if resampled:
        notes.append(
            f"times are up to {resampled:.2g} steps off an even grid of {step:.6g} s: interpolated"
        )
    return 1 / step, tuple(records), tuple(notes)
