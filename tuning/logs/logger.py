"""What a logger stores besides readings: zeros until a sensor answers, and each reading repeated.

A wireless node or a data logger may start a record before its sensor has answered, and may ask the
sensor more often than it reads. Both look like impacts: a zero far from gravity is a spike, and
held values change by steps.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import resample_poly

from tuning.logs.log import Log, between_gaps

UNREAD_SD = 12.0  # robust standard deviations of a channel from its median to zero
MIN_CHANGE = 4.0  # of the resolution of a channel: smaller changes may be those of a coarse one
MIN_CHANGES = 32  # of such size, to tell that values are held
HELD_SHARE = 0.9  # of these changes, after which the next sample is the same
OPTION = "  [--as-logged]"  # of the command line, with which nothing of this is done
EVEN_SHARE = 0.8  # of the times until the next change that are usual, within a sample


def unread(values: Float[np.ndarray, " time"]) -> Bool[np.ndarray, " time"]:
    """Samples of a channel that are zero and far outside the range of all others.

    >>> import numpy as np
    >>> from tuning.logs.logger import unread
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
    >>> from tuning.logs.logger import samples_held
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
            many = f"{none.sum()} samples" if none.sum() > 1 else "one sample"
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
