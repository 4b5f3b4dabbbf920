"""Logs of one experiment by several loggers, whose clocks differ, joined to one log.

    log = align_logs([read_log("node1.csv"), read_log("node2.csv")])

The offset of each clock from the first is that at which the signals correlate most; the error of
its rate follows from the offsets in parts of the log.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.signal import correlate, detrend

from tuning.logs.log import Log, even_records

PARTS = 4  # parts of a log whose offsets show the error of a clock's rate
# Largest correlation of two independent signals, over all offsets, in standard deviations.
FALSE_ALARM_SD = 6.0
MIN_CORRELATION = 0.3


def align_logs(logs: Sequence[Log]) -> Log:
    """Join several logs to one: all channels, at the sampling rate of the first, over common times.

    A reading of one node is in phase or in antiphase with that of another in each mode, so that the
    largest absolute value of the correlation counts. `notes` give the offset and rate of each clock
    with the correlation.

    Raises ValueError for logs that have gaps, or no common signal.

    >>> import numpy as np
    >>> import tuning
    >>> signal = np.convolve(np.random.default_rng(0).normal(size=400), np.ones(5) / 5, "same")
    >>> times, rest = 0.01 * np.arange(400), (("acceleration",), ("m/s^2",))
    >>> a = tuning.Log(times, signal[:, None], ("a",), *rest)
    >>> b = tuning.Log(times, np.roll(signal, 7)[:, None], ("b",), *rest)  # 0.07 s late
    >>> tuning.logs.align_logs([a, b]).names
    ('a', 'b')
    """
    if len(logs) < 2:
        raise ValueError(f"alignment needs two logs or more, not {len(logs)}")
    first, *others = [_single_record(log) for log in logs]
    rate, reference_start, reference = first
    times = reference_start + np.arange(len(reference)) / rate
    columns, notes = [reference], [*logs[0].notes]
    low, high = times[0], times[-1]
    for log, (own_rate, start, values) in zip(logs[1:], others, strict=True):
        own = start + np.arange(len(values)) / own_rate
        offset, stretch, correlation = _clock(times, reference, own, values, log.source)
        mapped = own[0] + offset + (own - own[0]) * stretch
        low, high = max(low, mapped[0]), min(high, mapped[-1])
        columns.append(
            np.stack([np.interp(times, mapped, column) for column in values.T], axis=1)
            if own_rate >= 20 * rate
            else _spline(mapped, values, times)
        )
        notes.append(
            f"{log.source}: clock aligned by correlation ({correlation:.2f}): "
            f"{offset:+.4f} s, rate {1e6 * (stretch - 1):+.0f} ppm"
        )
    keep = (times >= low) & (times <= high)
    if keep.sum() < 2:
        raise ValueError(f"{logs[0].source}: after alignment the logs have no time in common")
    names = [name for log in logs for name in log.names]
    if len(set(names)) < len(names):
        names = [f"{i + 1}.{name}" for i, log in enumerate(logs) for name in log.names]
    return Log(
        times=times[keep],
        values=np.hstack(columns)[keep],
        names=tuple(names),
        quantities=tuple(q for log in logs for q in log.quantities),
        units=tuple(u for log in logs for u in log.units),
        source=logs[0].source,
        sensors=tuple(s for log in logs for s in log.sensors),
        positions=tuple(p for log in logs for p in log.positions),
        actuators=tuple(a for log in logs for a in log.actuators),
        loads=logs[0].loads,
        notes=tuple(notes),
    )


def _single_record(log: Log):
    rate, records, _ = even_records(log)
    if len(records) != 1:
        raise ValueError(f"{log.source}: a log with gaps cannot be aligned; cut it at its gaps")
    return rate, records[0].start, records[0].values


def _spline(times, values, at):
    from scipy.interpolate import CubicSpline

    inside = np.clip(at, times[0], times[-1])
    return CubicSpline(times, values, axis=0)(inside)


def _clock(times, reference, own, values, source) -> tuple[float, float, float]:
    """Offset (s) of a clock, ratio of its seconds to those of the reference, and correlation."""
    step = times[1] - times[0]
    a = _signal(reference)
    # Both signals on one grid: that of the reference.
    grid = own[0] + step * np.arange(int((own[-1] - own[0]) / step) + 1)
    b = _signal(_spline(own, values, grid))
    lag, correlation, significant = _lag(a, b)
    if not significant or correlation < MIN_CORRELATION:
        raise ValueError(
            f"{source}: it has no signal in common with the first log (largest correlation "
            f"{correlation:.2f}); are they of one experiment?"
        )
    offset = times[0] + lag * step - grid[0]
    # Offsets of parts against the reference near them.
    size, found = b.size // PARTS, []
    for part in range(PARTS):
        piece = b[part * size : (part + 1) * size]
        position = round(lag) + part * size
        margin = max(size // 8, 8)
        low, high = max(position - margin, 0), min(position + size + margin, a.size)
        if high - low < size or np.std(piece) == 0:
            continue
        own_lag, strength, good = _lag(a[low:high], piece)
        if good and strength > MIN_CORRELATION:
            found.append(((part + 0.5) * size, low + own_lag - part * size, strength))
    if len(found) < 2:
        return offset, 1.0, correlation
    middle, lags, weights = np.array(found).T
    slope, level = np.polyfit(middle, lags, 1, w=weights)
    return times[0] + level * step - grid[0], 1 + slope, correlation


def _signal(values: Float[np.ndarray, "time channel"]) -> Float[np.ndarray, " time"]:
    """The channel of a node with most energy, whitened so that no single mode dominates."""
    levels = detrend(values, axis=0)
    signal = levels[:, np.argmax(np.var(levels, axis=0))]
    spectrum = np.fft.rfft(signal * np.hanning(signal.size))
    size = np.abs(spectrum)
    floor = np.sqrt(np.mean(size**2)) + 1e-300
    return np.fft.irfft(spectrum / np.sqrt(size * floor + 1e-2 * floor**2), signal.size)


def _lag(a, b) -> tuple[float, float, bool]:
    """Lag of b in a (samples), the correlation at it, and whether that is significant."""
    products = correlate(a, b, mode="full", method="fft")
    lags = np.arange(-b.size + 1, a.size)
    energy_a = np.concatenate([[0.0], np.cumsum(a**2)])
    energy_b = np.concatenate([[0.0], np.cumsum(b**2)])
    start, stop = np.maximum(lags, 0), np.minimum(lags + b.size, a.size)
    overlap = stop - start
    norms = np.sqrt(
        (energy_a[stop] - energy_a[start]) * (energy_b[stop - lags] - energy_b[start - lags])
    )
    enough = overlap >= min(a.size, b.size) // 4
    coefficient = np.where(enough, np.abs(products) / (norms + 1e-300), 0.0)
    best = int(np.argmax(coefficient))
    spread = np.median(coefficient[enough]) / 0.6745
    shift = 0.0
    if 0 < best < coefficient.size - 1:
        left, here, right = np.abs(products[best - 1 : best + 2])
        bend = left - 2 * here + right
        shift = 0.0 if bend == 0 else float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))
    value = float(coefficient[best])
    return float(lags[best] + shift), value, bool(value > FALSE_ALARM_SD * spread)
