"""ASAM measurement data (.mf4, .mdf), by asammdf: groups of channels, each with its own times."""

import contextlib
import dataclasses
import gc
import io
import logging
import sys
from pathlib import Path

import numpy as np

from jaxbeam.runtime.packages import import_extra
from tuning.logs.readers.table import (
    Clock,
    LogFormat,
    LogTable,
    at_times,
    damaged_file_error,
    date_of,
    is_time_name,
    parse_heading,
    read_bytes,
    table_of,
)

EVEN = 1e-3  # of a step: times that differ by less from equal steps have them


def read_mdf(path: Path) -> dict[str, LogTable]:
    """Table of the one run of a measurement file, by the name "".

    Channels of one group have its times. Those of several groups, as at other rates, are joined by
    the start and step of each, with a warning; uneven times, as of messages on a bus, become even
    by interpolation, with another. Channels of text are left out; a name that several groups have,
    or that is one of times, gets the number of the group. Samples that the file marks as invalid
    are NaN.

    Raises ValueError for a damaged file, ImportError without asammdf.
    """
    asammdf = import_extra("asammdf", "mdf")
    content = io.BytesIO(read_bytes(path))
    try:
        with _silenced():
            groups, origin = _groups(asammdf, content)
    except Exception as error:  # asammdf raises many types for damaged files
        raise damaged_file_error(path, error) from None
    arrays, units, clocks = {}, {}, {}
    for number, (times, channels) in groups.items():
        for signal in channels:
            name = signal.name
            if name in arrays or is_time_name(parse_heading(name)[0], signal.unit):
                name = f"{name} of group {number}"
            arrays[name], units[name] = _samples(signal, times), signal.unit or None
            clocks[name] = times
    first = next(iter(clocks.values()), np.zeros(0))
    if not clocks:
        return {}
    if all(np.array_equal(times, first) for times in clocks.values()):
        table = table_of(str(path), {"time": first, **arrays}, units | {"time": "s"})
        return {"": dataclasses.replace(table, start=date_of(origin + float(first[0])))}
    own, said = {}, []
    for name, times in clocks.items():
        own[name], arrays[name], words = _at_even_times(times, arrays[name])
        said += [f"{name}: {words}"] if words else []
    return {"": table_of(str(path), arrays, units, own, said, origin)}


@contextlib.contextmanager
def _silenced():
    """Suppress messages of asammdf, and what it prints as it drops a file it could not open."""
    hook, logger = sys.unraisablehook, logging.getLogger("asammdf")
    level = logger.level
    sys.unraisablehook = lambda _: None
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        sys.unraisablehook = hook
        logger.setLevel(level)


def _samples(signal, times: np.ndarray) -> np.ndarray:
    """Samples of a signal at the times (s) of its group; NaN at those that it lacks as invalid."""
    if len(signal.samples) == times.size:
        return signal.samples
    found = np.full((times.size, *signal.samples.shape[1:]), np.nan)
    found[np.searchsorted(times, signal.timestamps)] = signal.samples
    return found


def _groups(asammdf, content) -> tuple[dict[int, tuple[np.ndarray, list]], float]:
    """Times (s) and signals of numbers of each group that has any, and their zero, s since 1970."""
    problem = None
    try:
        with asammdf.MDF(content) as file:
            found = {}
            for number, group in enumerate(file.groups):
                master = file.masters_db.get(number)
                index = [i for i in range(len(group.channels)) if i != master]
                signals = [file.get(group=number, index=i) for i in index]
                signals = [s for s in signals if s.samples.dtype.kind in "iuf" and s.samples.size]
                found |= {number: (file.get_master(number), signals)} if signals else {}
            return found, file.start_time.timestamp()
    except Exception as error:
        problem = str(error).replace(f"'{content}'", "it") or type(error).__name__
    gc.collect()  # of the broken file, while what it prints is suppressed
    raise ValueError(problem)


def _at_even_times(times: np.ndarray, values: np.ndarray) -> tuple[Clock, np.ndarray, str]:
    """Start and step of the times (s) of values, the values then, and what was done; "" if none.

    Values at uneven times are interpolated to the usual step; NaN where none is within a step.
    """
    steps = np.diff(times)
    mean = (times[-1] - times[0]) / max(1, steps.size)
    if not np.any(np.abs(steps - mean) > EVEN * mean):
        return Clock(float(times[0]), float(mean)), values, ""
    step = float(np.mean(steps[steps < 2 * np.median(steps)]))  # without silences
    grid = times[0] + step * np.arange(1 + round((times[-1] - times[0]) / step))
    found = at_times(times, values, grid, step)
    range_words = f"steps of {steps.min():.3g} to {steps.max():.3g} s"
    words = f"uneven times, {range_words}, interpolated to {step:.6g} s"
    return Clock(float(times[0]), step), found, words


FORMAT = LogFormat("ASAM MDF", read_mdf, suffixes=(".mf4", ".mdf"), magics=(b"MDF     ",))
