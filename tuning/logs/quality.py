"""Faults of logged samples: gaps, clock drift, offsets, held, missing, clipped and stuck values.

Faulty samples are reported, and left out of fits only on request:

for fault in find_faults(log):
    print(fault)
log = mask(log, ["spikes", "saturation"])

A wireless node or a data logger may start a record before its sensor has answered, and may ask the
sensor more often than it reads. Both look like impacts: a zero far from gravity is a spike, and
held values change by steps.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter
from scipy.signal import resample_poly

from jaxbeam.case.arguments import checks_classes
from jaxbeam.runtime.printer import counted
from tuning.logs.log import GAP_STEPS, Log, between_gaps
from tuning.logs.units import STANDARD_GRAVITY

UNREAD_SD = 12.0  # robust standard deviations of a channel from its median to zero
MIN_CHANGE = 4.0  # of the resolution of a channel: smaller changes may be those of a coarse one
MIN_CHANGES = 32  # of such size, to tell that values are held
HELD_SHARE = 0.9  # of these changes, after which the next sample is the same
OPTION = "  [--as-logged]"  # of the command line, with which nothing of this is done
EVEN_SHARE = 0.8  # of the times until the next change that are usual, within a sample


def unread(values: Float[np.ndarray, " time"]) -> Bool[np.ndarray, " time"]:
    """Samples of a channel that are zero and far outside the range of all others.

    >>> import numpy as np
    >>> from tuning.logs.quality import unread
    >>> unread(np.array([0.0, 9.81, 9.80, 9.82, 9.79])).tolist()
    [True, False, False, False, False]
    """
    zero = values == 0.0
    others = values[~zero]
    if not zero.any() or others.size <= zero.sum() or others.min() <= 0.0 <= others.max():
        return np.zeros(values.size, bool)
    middle = np.median(others)
    deviation = 1.4826 * np.median(np.abs(others - middle))
    return zero & bool(np.abs(middle) > UNREAD_SD * deviation)


def samples_held(values: Float[np.ndarray, " time"]) -> float:
    """For how many samples a channel holds each reading, on average; 1 if it does not.

    After a change by several steps of its resolution the next sample is the same, and the time
    until the next change is always as long, within a sample. A coarse resolution repeats values,
    too, but not after such changes.

    >>> import numpy as np
    >>> from tuning.logs.quality import samples_held
    >>> samples_held(np.repeat(np.random.default_rng(0).normal(size=100), 4))
    4.0
    """
    steps = np.abs(np.diff(values))
    changes = np.flatnonzero(steps)
    if changes.size < MIN_CHANGES:
        return 1.0
    large = steps[changes] >= MIN_CHANGE * steps[changes].min()
    held = np.diff(changes)[large[:-1]]
    if held.size < MIN_CHANGES or np.mean(held > 1) < HELD_SHARE:
        return 1.0
    usual = held[np.abs(held - np.median(held)) <= 1.0]
    return float(np.mean(usual)) if usual.size >= EVEN_SHARE * held.size else 1.0


def sensor_readings(log: Log) -> Log:
    """The log with readings alone, at the rate at which its sensors read.

    Samples that are not valid, or zero before a sensor has answered, are interpolated; a log all of
    whose channels hold each reading for some samples is decimated by their number, record by
    record. `notes` say what was done.
    """
    valid, notes = np.array(log.valid), list(log.notes)
    for i, name in enumerate(log.names):
        none = unread(log.values[:, i]) & valid[:, i]
        if none.any():
            valid[none, i] = False
            many = counted(none.sum(), "sample")
            notes.append(
                f"{name} reads 0 in {many}, as if its sensor did not answer: interpolated{OPTION}"
            )
    if not valid.all():
        values = interpolate_invalid(log.times, log.values, valid)
        log = dataclasses.replace(log, values=values, valid=None, notes=tuple(notes))
    held = [samples_held(column) for column in log.values.T if np.ptp(column) > 0]
    most = min(held, default=1.0)
    if most == 1.0:
        return log
    step, parts = between_gaps(log.times)
    factor = int(np.ceil(most - 0.05))
    notes.append(
        f"each reading is held for {most:.3g} samples: decimated from {1 / step:.5g} Hz to "
        f"{1 / step / factor:.5g} Hz{OPTION}"
    )
    times, values = [], []
    for start, stop in parts:
        part = log.values[start:stop]
        times.append(log.times[start:stop:factor])
        # Offsets such as gravity would ring at the ends of the anti-alias filter.
        values.append(
            resample_poly(part, 1, factor, axis=0, padtype="line")
            if len(part) > 2 * factor
            else part[::factor]
        )
    return dataclasses.replace(
        log,
        times=np.concatenate(times),
        values=np.concatenate(values),
        valid=None,
        notes=tuple(notes),
    )


def interpolate_invalid(
    times: Float[np.ndarray, " time"],
    values: Float[np.ndarray, "time channel"],
    valid: Bool[np.ndarray, "time channel"],
) -> Float[np.ndarray, "time channel"]:
    """Values with linear interpolation over the samples that are not valid."""
    filled = np.array(values)
    for column, good in zip(filled.T, valid.T, strict=True):
        if good.any():
            column[~good] = np.interp(times[~good], times[good], column[good])
    return filled


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


@checks_classes
def find_faults(log: Log) -> list[Fault]:
    """Gaps, clock drift, offsets, held readings, spikes, and missing, clipped and stuck samples.

    >>> import numpy as np
    >>> import tuning
    >>> times = 0.01 * np.arange(200)
    >>> values = np.where(times == 0.5, 9.0, np.sin(6 * times))[:, None]
    >>> print(*tuning.logs.find_faults(tuning.Log(times, values, ("d1",), ("deflection",), ("m",))))
    log: d1 has spikes (1 sample), first at t = 0.5 s
    """
    found = [*_gaps(log), *_clock_drift(log), *_offsets(log), *_held(log)]
    for i, name in enumerate(log.names):
        for kind, rule in _SAMPLE_FAULTS.items():
            samples = rule.find(log.values[:, i]) & log.valid[:, i]
            if samples.any():
                found.append(Fault(kind, name, samples, _message(log, rule, name, samples)))
    return found


@checks_classes
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
            notes.append(f"{counted(count, 'sample')} of {fault.channel} left out ({fault.kind})")
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
    what = rule.sentence.format(channel=channel, count=counted(count, "sample"))
    return f"{log.source}: {what}, first at t = {first:.6g} s"
