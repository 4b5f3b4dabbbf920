"""ASAM measurement data (.mf4, .mdf), by asammdf: groups of channels, each with its own times."""

import contextlib
import gc
import io
import logging
import sys
from pathlib import Path

import numpy as np

from tuning.logs.clocks import Clock
from tuning.logs.readers.table import (
    LogFormat,
    LogTable,
    damaged_file_error,
    read_bytes,
    table_of,
)
from tuning.optional import import_extra

EVEN = 1e-3  # of a step: times that differ by less from equal steps have them


def read_mdf(path: Path) -> dict[str, LogTable]:
    """Table of the one run of a measurement file, by the name "".

    Channels of one group have its times. Those of several groups, as at other rates, are joined by
    the start and step of each, with a warning. Channels of text are left out; a name that several
    groups have is told apart by the number of the group.

    Raises ValueError for a damaged file, and for several groups of which one has uneven times;
    ImportError without asammdf.
    """
    asammdf = import_extra("asammdf", "mdf")
    content = io.BytesIO(read_bytes(path))
    try:
        with _silenced():
            groups = _groups(asammdf, content)
    except Exception as error:  # asammdf raises many types for damaged files
        raise damaged_file_error(path, error) from None
    arrays, units, clocks = {}, {}, {}
    for number, channels in groups.items():
        for signal in channels:
            name = signal.name if signal.name not in arrays else f"{signal.name} of group {number}"
            arrays[name], units[name] = signal.samples, signal.unit or None
            clocks[name] = signal.timestamps
    if len(groups) < 2:
        arrays = {"time": next(iter(clocks.values()), np.zeros(0)), **arrays}
        return {"": table_of(str(path), arrays, units | {"time": "s"})} if clocks else {}
    return {"": table_of(str(path), arrays, units, {n: _clock(path, n, clocks[n]) for n in clocks})}


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


def _groups(asammdf, content) -> dict[int, list]:
    """Signals of numbers of each group that has any, without its times."""
    problem = None
    try:
        with asammdf.MDF(content) as file:
            found = {}
            for number, group in enumerate(file.groups):
                times = file.masters_db.get(number)
                index = [i for i in range(len(group.channels)) if i != times]
                signals = [file.get(group=number, index=i) for i in index]
                signals = [s for s in signals if s.samples.dtype.kind in "iuf" and s.samples.size]
                found |= {number: signals} if signals else {}
            return found
    except Exception as error:
        problem = f"{type(error).__name__}: {error}"
    gc.collect()  # of the broken file, while what it prints is suppressed
    raise ValueError(problem)


def _clock(path: Path, name: str, times: np.ndarray) -> Clock:
    """Start and step of even times (s) of a channel."""
    step = (times[-1] - times[0]) / max(1, times.size - 1)
    if np.any(np.abs(np.diff(times) - step) > EVEN * step):
        raise ValueError(
            f"{path}: the times of {name} are uneven, and other groups have others: resample the"
            " groups to one rate, or save them to separate files"
        )
    return Clock(float(times[0]), float(step))


FORMAT = LogFormat("ASAM MDF", read_mdf, suffixes=(".mf4", ".mdf"), magics=(b"MDF     ",))
