"""What is wrong with the samples of a log: found and said; left out of fits only when asked.

for fault in find_faults(log):
    print(fault)
log = mask(log, ["spikes", "saturation"])         # fits leave these samples out
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter

if TYPE_CHECKING:
    from tuning.logs.log import Log

MASKABLE = ("spikes", "saturation", "stuck")
GAP_STEPS = 1.5  # steps between two samples, beyond which some are missing
SPIKE_SD = 12.0  # robust standard deviations off the smooth course of the neighbours
SPIKE_WINDOW_SAMPLES = 31  # samples within which what is usual is told
MIN_SPIKE_RANGE_SHARE = 0.02  # of a channel's range
MIN_CLIPPED_SAMPLES = 4  # samples at an extreme value, and no fewer, that look clipped
MIN_STUCK_SAMPLES = 12  # samples of one value in a channel that otherwise never repeats itself
MAX_CLOCK_DRIFT_STEPS = 0.5  # steps by which times bend away from an even grid


@dataclasses.dataclass(frozen=True, eq=False)
class Fault:
    """Something wrong with a channel (None: with the times), and the samples it is about."""

    kind: str
    channel: str | None
    samples: Bool[np.ndarray, " time"]
    message: str

    def __str__(self) -> str:
        return self.message


def find_faults(log: Log) -> list[Fault]:
    """Look for gaps, drifting clocks, spikes, clipped and stuck channels in a log."""
    found = [*_gaps(log), *_clock_drift(log)]
    finders = {"spikes": _spikes, "saturation": _clipped, "stuck": _stuck}
    for i, name in enumerate(log.names):
        for kind, find in finders.items():
            samples = find(log.values[:, i]) & log.valid[:, i]
            if samples.any():
                found.append(Fault(kind, name, samples, _message(log, kind, name, samples)))
    return found


def mask(log: Log, kinds: Sequence[str]) -> Log:
    """The log without the samples of some kinds of faults, as far as fits are concerned.

    Its `valid` says which samples remain, its `notes` how many do not; the values stay.

    Raises ValueError for a kind that is not one of `MASKABLE`.
    """
    for kind in kinds:
        if kind not in MASKABLE:
            raise ValueError(f"{kind!r} cannot be masked; {', '.join(MASKABLE)} can")
    valid, notes = np.array(log.valid), list(log.notes)
    for fault in find_faults(log):
        if fault.kind in kinds:
            valid[fault.samples, log.names.index(fault.channel)] = False
            count = int(fault.samples.sum())
            notes.append(f"{count} samples of {fault.channel} are left out ({fault.kind})")
    return dataclasses.replace(log, valid=valid, notes=tuple(notes))


def interpolate_invalid(
    times: Float[np.ndarray, " time"],
    values: Float[np.ndarray, "time channel"],
    valid: Bool[np.ndarray, "time channel"],
) -> Float[np.ndarray, "time channel"]:
    """Straight lines over the samples that are not valid, so that there is a value at all."""
    filled = np.array(values)
    for column, good in zip(filled.T, valid.T, strict=True):
        if good.any():
            column[~good] = np.interp(times[~good], times[good], column[good])
    return filled


def _gaps(log: Log):
    steps = np.diff(log.times)
    usual = np.median(steps)
    for i in np.flatnonzero(steps > GAP_STEPS * usual):
        samples = np.zeros(log.times.size, bool)
        samples[i : i + 2] = True
        lost = round(steps[i] / usual) - 1
        message = f"{log.source}: about {lost} samples are missing after t = {log.times[i]:.6g} s"
        yield Fault("gaps", None, samples, message)


def _clock_drift(log: Log):
    """Times that bend: a clock whose rate changes (a rate that is merely wrong leaves no trace)."""
    count = np.linspace(-1, 1, log.times.size)
    if log.times.size < 4 or np.any(np.diff(log.times) > GAP_STEPS * np.median(np.diff(log.times))):
        return
    curvature = np.polynomial.legendre.legfit(count, log.times, 2)[2] * 1.5
    step = log.duration / (log.times.size - 1)
    if abs(curvature) > MAX_CLOCK_DRIFT_STEPS * step:
        yield Fault(
            "drift",
            None,
            np.ones(log.times.size, bool),
            f"{log.source}: the clock drifts: midway the times are {abs(curvature) / step:.2g} steps "
            "off an even grid",
        )


def _spikes(values: Float[np.ndarray, " time"]) -> Bool[np.ndarray, " time"]:
    """Single samples far off the cubic through their two neighbours on either side."""
    spikes = np.zeros(values.size, bool)
    if values.size < 9:
        return spikes
    left2, left, here, right, right2 = (values[i : values.size - 4 + i] for i in range(5))
    deviation = np.abs(here - (4 * (left + right) - left2 - right2) / 6)
    # As much as is usual around: an impact rings too fast for cubics, but not for one sample.
    local_median = median_filter(deviation, SPIKE_WINDOW_SAMPLES, mode="nearest")
    noise_level = 1.4826 * np.maximum(local_median, np.median(deviation))
    # A spike stands out to both sides; a jump, or a neighbour of a spike, does not.
    rise, fall = here - left, here - right
    prominence = np.minimum(np.abs(rise), np.abs(fall)) * (rise * fall > 0)
    least = np.maximum(
        SPIKE_SD * noise_level, MIN_SPIKE_RANGE_SHARE * np.ptp(np.sort(values)[1:-1])
    )
    spikes[2:-2] = (prominence > deviation / 2) & (deviation > least)
    return spikes


def _constant_runs(values: Float[np.ndarray, " time"], min_length: int):
    """Stretches (start, stop) of at least so many equal samples."""
    run_starts = np.flatnonzero(np.diff(values) != 0) + 1
    run_starts = np.concatenate([[0], run_starts, [values.size]])
    return [(a, b) for a, b in zip(run_starts, run_starts[1:], strict=False) if b - a >= min_length]


def _clipped(values: Float[np.ndarray, " time"]) -> Bool[np.ndarray, " time"]:
    """Stretches at the largest or smallest value that the signal enters and leaves steeply."""
    clipped = np.zeros(values.size, bool)
    steps = np.abs(np.diff(values))
    resolution = np.min(steps[steps > 0], initial=np.inf)
    for start, stop in _constant_runs(values, MIN_CLIPPED_SAMPLES):
        inside = start > 0 and stop < values.size
        extreme = values[start] in (values.max(), values.min())
        steep = inside and min(steps[start - 1], steps[stop - 1]) > 3 * resolution
        clipped[start:stop] |= extreme and steep
    return clipped


def _stuck(values: Float[np.ndarray, " time"]) -> Bool[np.ndarray, " time"]:
    """Long stretches of one value in a channel whose samples otherwise differ."""
    stuck = np.zeros(values.size, bool)
    if values.size < 2 * MIN_STUCK_SAMPLES or np.median(np.abs(np.diff(values))) == 0.0:
        return stuck
    rare = (
        len(_constant_runs(values, MIN_STUCK_SAMPLES // 2)) <= 3
    )  # a coarse resolution makes many such stretches
    for start, stop in _constant_runs(values, MIN_STUCK_SAMPLES):
        stuck[start:stop] = rare
    return stuck & ~_clipped(values)


def _message(log: Log, kind: str, name: str, samples) -> str:
    first, count = log.times[np.argmax(samples)], int(samples.sum())
    number = f"{count} samples" if count > 1 else "one sample"
    what = {
        "spikes": f"{name} has spikes ({number})",
        "saturation": f"{name} looks clipped at the end of its range ({number})",
        "stuck": f"{name} stays at one value for {number}",
    }[kind]
    return f"{log.source}: {what}, first at t = {first:.6g} s"
