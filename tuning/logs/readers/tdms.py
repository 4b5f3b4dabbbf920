"""LabVIEW TDMS files (.tdms), by npTDMS: each group of channels is a run."""

import contextlib
import logging
import warnings
from pathlib import Path

import numpy as np

from tuning.logs.readers.table import (
    LogFormat,
    LogTable,
    damaged_file_error,
    is_time_name,
    table_of,
    text_attribute,
)
from tuning.optional import import_extra

MAGIC = b"TDSm"


def read_tdms(path: Path) -> dict[str, LogTable]:
    """Tables of a TDMS file: one run for each group with numbers, by the name of the group.

    Times are a channel called time, or follow from the waveform properties `wf_increment` and
    `wf_start_offset` of the channels; units are the property `unit_string`.

    Raises ValueError for a damaged file and for channels of a group that differ in their times,
    ImportError without npTDMS.
    """
    nptdms = import_extra("nptdms", "tdms")
    try:
        with _silenced(nptdms):
            file = nptdms.TdmsFile.read(path)
            groups = {group.name: _channels(group) for group in file.groups()}
    except Exception as error:  # npTDMS raises many types for damaged files
        raise damaged_file_error(path, error) from None
    notes = ["the recording breaks off within a segment"] if _is_truncated(file) else []
    runs = {}
    for name, channels in groups.items():
        numeric = {label: channel[:] for label, channel in channels.items()}
        numeric = {a: b for a, b in numeric.items() if np.issubdtype(b.dtype, np.number)}
        if numeric:
            source = f"{path}, group {name!r}"
            units = {a: text_attribute(channels[a].properties.get("unit_string")) for a in numeric}
            clock = _times_function(source, {a: channels[a] for a in numeric})
            runs[name] = table_of(source, numeric, units, clock, notes)
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


def _is_truncated(file) -> bool:
    return bool(file.file_status.incomplete_final_segment)


def _times_function(source, channels):
    """Function from a number of samples to times (s), from waveform properties, or None."""
    grids = {
        (p["wf_increment"], p.get("wf_start_offset", 0.0))
        for name, channel in channels.items()
        if not is_time_name(name) and "wf_increment" in (p := channel.properties)
    }
    if len(grids) > 1:
        raise ValueError(
            f"{source}: the channels have different times; resample them to common times, or save "
            "them to separate groups"
        )
    if not grids:
        return None
    ((step, start),) = grids
    return lambda count: start + step * np.arange(count)


FORMAT = LogFormat("LabVIEW (TDMS)", read_tdms, suffixes=(".tdms",), magics=(MAGIC,))
