"""LabVIEW TDMS files (.tdms), by npTDMS: each group of channels is a run."""

import contextlib
import dataclasses
import logging
import warnings
from pathlib import Path

import numpy as np

from jaxbeam.runtime.packages import import_extra
from tuning.logs.readers.table import (
    Clock,
    LogFormat,
    LogTable,
    clocks_of,
    damaged_file_error,
    date_of,
    is_time_name,
    table_of,
    text_attribute,
)

MAGIC = b"TDSm"
EPOCH, SECOND = np.datetime64(0, "s"), np.timedelta64(1, "s")


def read_tdms(path: Path) -> dict[str, LogTable]:
    """Tables of a TDMS file: one run for each group with numbers, by the name of the group.

    Times are a channel called time, or of dates, or follow from the waveform properties
    `wf_increment`, `wf_start_time` and `wf_start_offset` of the channels, which are aligned by
    them, with a warning; units are the property `unit_string`.

    Raises ValueError for a damaged file and for channels of a group without a time in common,
    ImportError without npTDMS.
    """
    nptdms = import_extra("nptdms", "tdms")
    try:
        with _silenced(nptdms):
            with open(path, "rb") as opened:  # by name, an old .tdms_index of it would be read
                file = nptdms.TdmsFile.read(opened)
            groups = {group.name: _channels(group) for group in file.groups()}
            samples = {
                name: {label: channel[:] for label, channel in channels.items()}
                for name, channels in groups.items()
            }
    except Exception as error:  # npTDMS raises many types for damaged files
        raise damaged_file_error(path, error) from None
    truncated = file.file_status.incomplete_final_segment
    broken = ["the recording breaks off within a segment"] if truncated else []
    runs = {}
    for name, channels in groups.items():
        numeric = {a: b for a, b in samples[name].items() if np.issubdtype(b.dtype, np.number)}
        if numeric:
            source = f"{path}, group {name!r}"
            units = {a: text_attribute(channels[a].properties.get("unit_string")) for a in numeric}
            clocks, origin = _clocks({a: channels[a] for a in numeric}, units)
            dates = [b for b in samples[name].values() if b.dtype.kind == "M" and b.size]
            timed = clocks or any(is_time_name(a, units[a]) for a in numeric)
            if timed or not dates:
                runs[name] = table_of(source, numeric, units, clocks, broken, origin)
                continue
            numeric["time"], units["time"] = (dates[0] - dates[0][0]) / SECOND, "s"
            table = table_of(source, numeric, units, None, broken)
            start = date_of(float((dates[0][0] - EPOCH) / SECOND))
            runs[name] = dataclasses.replace(table, start=start)
    return runs


@contextlib.contextmanager
def _silenced(nptdms):
    """Suppress log messages and warnings of npTDMS; errors are raised here."""
    manager = nptdms.log.log_manager
    level = manager.log_level
    manager.set_level(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        manager.set_level(level)


def _channels(group):
    return {channel.name: channel for channel in group.channels()}


def _clocks(channels, units) -> tuple[dict[str, Clock] | None, float]:
    """Clocks of channels by their waveform properties, None if no channel has them.

    And the date of their zero, in s since 1970; 0 without one.
    """
    starts, steps, dates, origin = {}, {}, {}, 0.0
    for name, channel in channels.items():
        properties = channel.properties
        starts[name] = float(properties.get("wf_start_offset", 0.0))
        if "wf_increment" in properties and not is_time_name(name, units[name]):
            steps[name] = float(properties["wf_increment"])
            if isinstance(properties.get("wf_start_time"), np.datetime64):
                dates[name] = properties["wf_start_time"]
    if not steps:
        return None, origin
    if len(dates) == len(steps):  # of some only, it tells nothing of the others
        first = min(dates.values())
        origin = float((first - EPOCH) / SECOND)
        for name, date in dates.items():
            starts[name] += (date - first) / SECOND
    names = [name for name in channels if not is_time_name(name, units[name])]
    return clocks_of(names, starts, steps), origin


FORMAT = LogFormat("LabVIEW (TDMS)", read_tdms, suffixes=(".tdms",), magics=(MAGIC,))
