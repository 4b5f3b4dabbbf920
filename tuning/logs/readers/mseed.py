"""MiniSEED (.mseed), by obspy: traces of seismic recorders, each with its own start and rate."""

import dataclasses
import io
import warnings
from pathlib import Path

import numpy as np

from jaxbeam.files.endings import import_extra
from tuning.logs.readers.table import (
    Clock,
    LogFormat,
    LogTable,
    damaged_file_error,
    read_bytes,
    table_of,
)


def read_mseed(path: Path) -> dict[str, LogTable]:
    """Table of the traces of a file, called by their stations and channels.

    Parts of a trace are joined; samples that are missing between them are NaN. Traces of other
    starts or rates are aligned, with a warning. The file has no units: they are those of the
    recorder's counts until the user says others.

    Raises ValueError for a damaged file, ImportError without obspy.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of modules that obspy imports
        obspy = import_extra("obspy", "mseed")
        try:
            content = read_bytes(path)
            stream = obspy.read(io.BytesIO(content), format="MSEED")
            parts = [trace.stats.mseed for trace in stream]
            read = sum(part.number_of_records * part.record_length for part in parts)
            stream.merge()
        except Exception as error:  # obspy raises many types for damaged files
            raise damaged_file_error(path, error) from None
    if not stream:
        return {}
    first = min(trace.stats.starttime for trace in stream)
    arrays, clocks = {}, {}
    for trace in stream:
        name = trace.id.replace("..", ".").strip(".")
        samples = np.ma.filled(np.ma.asarray(trace.data, float), np.nan)
        arrays[name] = samples
        clocks[name] = Clock(float(trace.stats.starttime - first), float(trace.stats.delta))
    cut = "the file is cut off within a record: samples, or whole traces, are lost after it"
    said = [cut] if read < len(content) else []
    table = table_of(str(path), arrays, dict.fromkeys(arrays), clocks, said)
    start = first + float(table.values[0, table.names.index(table.time or table.names[0])])
    return {"": dataclasses.replace(table, start=start.datetime.isoformat())}


FORMAT = LogFormat("MiniSEED", read_mseed, suffixes=(".mseed", ".miniseed"), magics=())
