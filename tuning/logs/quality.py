"""Faults of logged samples: gaps, clock drift, offsets, held, missing, clipped and stuck values.

Faulty samples are reported, and left out of fits only on request:

for fault in find_faults(log):
    print(fault)
log = mask(log, ["spikes", "saturation"])
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter

from tuning.logs.log import GAP_STEPS, Log
from tuning.logs.logger import samples_held, unread
from tuning.logs.units import STANDARD_GRAVITY

SPIKE_SD = 12.0  # robust standard deviations between a spike and its neighbours
SPIKE_WINDOW_SAMPLES = 31  # samples around a spike, for that standard deviation
MIN_SPIKE_HEIGHT = 0.02  # height of a spike over the range of its channel
MIN_CLIPPED_READINGS = 4  # equal readings at an extreme value that are clipped
MIN_STUCK_SAMPLES = 12  # equal samples in a channel that otherwise never repeats a value
GRAVITY_TOLERANCE = 0.1  # of standard gravity, for the mean of an accelerometer that feels it
MAX_OFFSET_GRAVITIES = 1.2  # mean acceleration beyond which a sensor has no right zero or scale
MAX_CLOCK_DRIFT_STEPS = 0.5  # steps between times and an even grid, at mid-log


@dataclasses.dataclass(frozen=True, eq=False)
class Fault:
    """A fault of a channel (None: of the times), and the mask of the samples with it."""

    kind: str
    channel: str | None
    samples: Bool[np.ndarray, " time"]
    message: str

    def __str__(self) -> str:
        return self.message


def find_faults(log: Log) -> list[Fault]:
    """Gaps, clock drift, offsets, held readings, spikes, and missing, clipped and stuck samples.

    >>> import numpy as np
    >>> import tuning
    >>> times = 0.01 * np.arange(200)
    >>> values = np.where(times == 0.5, 9.0, np.sin(6 * times))[:, None]
    >>> print(*tuning.logs.find_faults(tuning.Log(times, values, ("d1",), ("deflection",), ("m",))))
    log: d1 has spikes (one sample), first at t = 0.5 s
    """
    found = [*_gaps(log), *_clock_drift(log), *_offsets(log), *_held(log)]
    for i, name in enumerate(log.names):
        for kind, rule in _SAMPLE_FAULTS.items():
            samples = rule.find(log.values[:, i]) & log.valid[:, i]
            if samples.any():
                found.append(Fault(kind, name, samples, _message(log, rule, name, samples)))
    return found


def mask(log: Log, kinds: Sequence[str]) -> Log:
    """The log with samples that have some kinds of faults marked as not valid, for fits.

    Its `notes` say how many samples are left out; the values stay.

    Raises ValueError for a kind that cannot be masked.

    >>> import numpy as np
    >>> import tuning
    >>> times = 0.01 * np.arange(200)
    >>> values = np.where(times == 0.5, 9.0, np.sin(6 * times))[:, None]
    >>> log = tuning.Log(times, values, ("d1",), ("deflection",), ("m",))
    >>> int((~tuning.logs.mask(log, ["spikes"]).valid).sum())
    1
    """
    for kind in kinds:
        if kind not in _SAMPLE_FAULTS:
            raise ValueError(f"{kind!r} cannot be masked; {', '.join(_SAMPLE_FAULTS)} can")
    valid, notes = np.array(log.valid), list(log.notes)
    for fault in find_faults(log):
        if fault.kind in kinds:
            valid[fault.samples, log.names.index(fault.channel)] = False
            count = int(fault.samples.sum())
            notes.append(f"{count} samples of {fault.channel} are left out ({fault.kind})")
    return dataclasses.replace(log, valid=valid, notes=tuple(notes))


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
    """Curved times: a clock whose rate changes (a constant error of the rate leaves no trace)."""
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
            f"{log.source}: the clock drifts: midway the times are {abs(curvature) / step:.2g} "
            "steps off an even grid",
        )


def _offsets(log: Log):
    """Accelerometers whose mean is gravity, or more than gravity can be."""
    for i, name in enumerate(log.names):
        if log.quantities[i] != "acceleration" or not log.valid[:, i].any():
            continue
        mean = float(np.median(log.values[log.valid[:, i], i])) / STANDARD_GRAVITY
        everywhere = np.ones(log.times.size, bool)
        if abs(abs(mean) - 1) < GRAVITY_TOLERANCE:
            message = f"{log.source}: {name} includes gravity (its median is {mean:.3f} g)"
            yield Fault("gravity", name, everywhere, message)
        elif abs(mean) > MAX_OFFSET_GRAVITIES:
            message = (
                f"{log.source}: {name} has an offset of {mean:.3g} g: the sensor is not calibrated"
            )
            yield Fault("offset", name, everywhere, message)


def _held(log: Log):
    """Channels whose readings are held for some samples."""
    for i, name in enumerate(log.names):
        held = samples_held(log.values[:, i])
        if held > 1:
            what = "reading" if log.actuators[i] is None else "command"
            message = f"{log.source}: {name} holds each {what} for {held:.3g} samples"
            yield Fault("held", name, np.ones(log.times.size, bool), message)


def _spikes(values: Float[np.ndarray, " time"]) -> Bool[np.ndarray, " time"]:
    """Single samples far from the cubic through their two neighbours on either side."""
    spikes = np.zeros(values.size, bool)
    if values.size < 9:
        return spikes
    left2, left, here, right, right2 = (values[i : values.size - 4 + i] for i in range(5))
    deviation = np.abs(here - (4 * (left + right) - left2 - right2) / 6)
    # Noise level nearby: an impact rings too fast for cubics, but for more than one sample.
    local_median = median_filter(deviation, SPIKE_WINDOW_SAMPLES, mode="nearest")
    noise_level = 1.4826 * np.maximum(local_median, np.median(deviation))
    # A spike stands out on both sides; a jump, or a neighbour of a spike, does not.
    rise, fall = here - left, here - right
    prominence = np.minimum(np.abs(rise), np.abs(fall)) * (rise * fall > 0)
    least = np.maximum(SPIKE_SD * noise_level, MIN_SPIKE_HEIGHT * np.ptp(np.sort(values)[1:-1]))
    spikes[2:-2] = (prominence > deviation / 2) & (deviation > least)
    return spikes


def _constant_runs(values: Float[np.ndarray, " time"], min_length: int):
    """Ranges (start, stop) of at least so many equal samples."""
    run_starts = np.flatnonzero(np.diff(values) != 0) + 1
    edges = np.concatenate([[0], run_starts, [values.size]])
    long = np.flatnonzero(np.diff(edges) >= min_length)
    return list(zip(edges[long].tolist(), edges[long + 1].tolist(), strict=True))


def _clipped(values: Float[np.ndarray, " time"]) -> Bool[np.ndarray, " time"]:
    """Equal readings at the largest or smallest value, reached and left steeply."""
    clipped = np.zeros(values.size, bool)
    least = int(np.ceil(MIN_CLIPPED_READINGS * samples_held(values)))
    steps = np.abs(np.diff(values))
    resolution = np.min(steps[steps > 0], initial=np.inf)
    for start, stop in _constant_runs(values, least):
        inside = start > 0 and stop < values.size
        extreme = values[start] in (values.max(), values.min())
        steep = inside and min(steps[start - 1], steps[stop - 1]) > 3 * resolution
        clipped[start:stop] |= extreme and steep
    return clipped


def _stuck(values: Float[np.ndarray, " time"]) -> Bool[np.ndarray, " time"]:
    """Long ranges of one value in a channel whose samples otherwise differ."""
    stuck = np.zeros(values.size, bool)
    if values.size < 2 * MIN_STUCK_SAMPLES or np.median(np.abs(np.diff(values))) == 0.0:
        return stuck
    # A coarse resolution leads to many such ranges.
    rare = len(_constant_runs(values, MIN_STUCK_SAMPLES // 2)) <= 3
    for start, stop in _constant_runs(values, MIN_STUCK_SAMPLES):
        stuck[start:stop] = rare
    return stuck & ~_clipped(values)


class _SampleFault(NamedTuple):
    """A kind of fault: function that finds its samples, and sentence about channel and count."""

    find: Callable[[Float[np.ndarray, " time"]], Bool[np.ndarray, " time"]]
    sentence: str


_SAMPLE_FAULTS = {
    "dropouts": _SampleFault(
        unread, "{channel} reads 0, as if its sensor did not answer ({count})"
    ),
    "spikes": _SampleFault(_spikes, "{channel} has spikes ({count})"),
    "saturation": _SampleFault(
        _clipped, "{channel} looks clipped at the end of its range ({count})"
    ),
    "stuck": _SampleFault(_stuck, "{channel} stays at one value for {count}"),
}


def _message(log: Log, rule: _SampleFault, channel: str, samples) -> str:
    first, count = log.times[np.argmax(samples)], int(samples.sum())
    number = f"{count} samples" if count > 1 else "one sample"
    what = rule.sentence.format(channel=channel, count=number)
    return f"{log.source}: {what}, first at t = {first:.6g} s"
