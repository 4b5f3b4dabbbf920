"""Samples of logs from which modes are identified: records in a window, with notes on faults.

The start of a log is left out while sensors settle: AC-coupled ones saturate when switched on.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.logs.log import Log
from tuning.logs.quality import find_faults
from tuning.logs.records import even_records

MIN_STUCK_SAMPLES = 12  # equal samples at the start of a channel that is saturated
MAX_SHARE = 0.5  # of a record that is left out


def settled_from(values: Float[np.ndarray, "time channel"]) -> int:
    """First sample from which all channels have settled; 0 if none starts at one stuck value.

    Of a channel that starts stuck, the samples left out are those that make the standard error of
    the mean of the others least (White, An effective truncation heuristic for bias reduction in
    simulation output, 1997), half of them at most.
    """
    starts = [_settled(column) for column in values.T if _is_stuck(column)]
    return max(starts, default=0)


def _is_stuck(column) -> bool:
    first = column[:MIN_STUCK_SAMPLES]
    return column.size > 2 * MIN_STUCK_SAMPLES and bool(
        np.all(first == first[0]) and np.ptp(column)
    )


def _settled(column) -> int:
    """Truncation d with the least sum of squared deviations of x[d:] over (n - d)^2."""
    backwards = column[::-1] - np.median(column)
    count = np.arange(1, column.size + 1)
    squares = np.cumsum(backwards**2) - np.cumsum(backwards) ** 2 / count
    left_out = column.size - count
    error = np.where(left_out <= MAX_SHARE * column.size, squares / count**2, np.inf)
    return int(left_out[np.argmin(error)])


MIN_SAMPLES = 64  # of a log
MAX_RATE_CHANGE = 1e-3  # of the sampling rate, between logs that are used together


class Samples(NamedTuple):
    """Records of all logs in SI units, with the times of their first samples (s)."""

    records: tuple[Float[np.ndarray, "time channel"], ...]
    starts: tuple[float, ...]
    rate: float
    notes: tuple[str, ...]

    def with_notes(self, notes: Sequence[str]) -> "Samples":
        """The samples with further notes."""
        return self._replace(notes=(*self.notes, *notes))


def samples_of(logs: Sequence[Log], window: tuple[float, float] | None) -> Samples:
    """Records of the logs in a window (s), and notes on the logs and their faults.

    Raises ValueError for logs too short, not evenly sampled, or different in channels or rate, and
    a window outside a log.
    """
    records, starts, rates, notes = [], [], [], []
    for log in logs:
        part = part_of_window(log, window)
        rate, found, said = even_records(part)
        rates.append(rate)
        settled = settled_from(found[0].values) if window is None else 0
        if settled:
            said = (
                *said,
                f"the first {settled / rate:.3g} s are left out, while a sensor settles  [--from]",
            )
        for i, record in enumerate(found):
            skipped = 0 if i else settled
            records.append(record.values[skipped:])
            starts.append(record.start + skipped / rate)
        faults = (str(fault).removeprefix(f"{log.source}: ") for fault in find_faults(part))
        notes += [*log.notes, *said, *faults]
        if not same_channels(log, logs[0]) or abs(rate / rates[0] - 1) > MAX_RATE_CHANGE:
            raise ValueError(
                f"{log.source}: logs identified together must have the same channels, positions "
                f"and sampling rate; {logs[0].source} has {', '.join(logs[0].names)} at "
                f"{rates[0]:.6g} Hz, this one {', '.join(log.names)} at {rate:.6g} Hz. Modes of "
                "setups with other sensors are found one by one and merged by"
                " tuning.modal.merge_setups"
            )
    return Samples(tuple(records), tuple(starts), rates[0], tuple(dict.fromkeys(notes)))


def same_channels(a: Log, b: Log) -> bool:
    """Whether two logs have channels of the same names, quantities and places."""
    return all(
        getattr(a, field) == getattr(b, field)
        for field in ("names", "quantities", "positions", "sensors")
    )


def part_of_window(log: Log, window: tuple[float, float] | None) -> Log:
    """The part of a log in a window (s), by default all.

    Raises ValueError for a window outside the log, and for too few samples.
    """
    start, stop = _sample_range(log, window)
    if stop - start < MIN_SAMPLES:
        raise ValueError(
            f"{log.source}: {stop - start} samples are too few to identify modes from; "
            f"at least {MIN_SAMPLES} are needed"
        )
    if (start, stop) == (0, log.times.size):
        return log
    return Log(
        log.times[start:stop], log.values[start:stop], log.names, log.quantities, log.units,
        log.source, valid=log.valid[start:stop],
    )  # fmt: skip


def with_channels(log: Log, channels: Sequence[str] | None) -> Log:
    """The log with the channels of some names, by default all that are no commands.

    Raises ValueError for a channel that the log has not.
    """
    if channels is None:
        kept = [i for i, actuator in enumerate(log.actuators) if actuator is None]
    else:
        unknown = [name for name in channels if name not in log.names]
        if unknown:
            raise ValueError(
                f"{log.source}: the log has no channel {unknown[0]!r}; it has "
                f"{', '.join(log.names)}"
            )
        kept = [log.names.index(name) for name in channels]
    if kept == list(range(len(log.names))):
        return log

    def pick(entries):
        return tuple(entries[i] for i in kept)

    return Log(
        log.times, log.values[:, kept], pick(log.names), pick(log.quantities), pick(log.units),
        log.source, pick(log.sensors), pick(log.positions), pick(log.actuators), log.loads,
        log.valid[:, kept], log.notes,
    )  # fmt: skip


def without_constant(logs: Sequence[Log]) -> tuple[list[Log], tuple[str, ...]]:
    """Logs of the same channels without those that stay at one value in all, and notes on these.

    Raises ValueError if no channel is left.
    """
    names, dead = logs[0].names, []
    if all(same_channels(log, logs[0]) for log in logs):  # others are refused later
        constant = np.all([np.ptp(log.values, axis=0) == 0 for log in logs], axis=0)
        dead = [name for name, one in zip(names, constant, strict=True) if one]
    if not dead:
        return list(logs), ()
    if len(dead) == len(names):
        raise ValueError(
            f"{logs[0].source}: each channel stays at one value: {', '.join(names)}; give others"
        )
    kept = [with_channels(log, [name for name in log.names if name not in dead]) for log in logs]
    return kept, tuple(f"{name} stays at one value: left out" for name in dead)


def _sample_range(log: Log, window) -> tuple[int, int]:
    """First and last (exclusive) sample of a window (s)."""
    if window is None:
        return 0, log.times.size
    step = log.duration / (log.times.size - 1)
    if not (log.times[0] <= window[0] < window[1] <= log.times[-1] + step):
        raise ValueError(
            f"{log.source}: the window from {window[0]:g} s to {window[1]:g} s is not within the "
            f"log, {log.times[0]:.6g} s to {log.times[-1]:.6g} s"
        )
    start, stop = np.searchsorted(log.times, window)
    return int(start), int(stop)
