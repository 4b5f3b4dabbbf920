"""Evenly sampled series: sound files (.wav), as loggers write them, too, and MiniSEED (.mseed)."""

import dataclasses
import io
import warnings
from pathlib import Path

import numpy as np
import scipy.io.wavfile

from jaxbeam.runtime.packages import import_extra
from tuning.logs.readers.table import (
    Clock,
    LogFormat,
    LogTable,
    damaged_file_error,
    read_bytes,
    table_of,
)

MAGICS = b"RIFF", b"RIFX", b"RF64"


def read_wav(path: Path) -> dict[str, LogTable]:
    """Table of the channels of a sound file, called channel 1, channel 2, ...

    Whole numbers become fractions of the range, between -1 and 1; others stay as they are.

    Raises ValueError for a damaged file.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of blocks that are not samples
            rate, samples = scipy.io.wavfile.read(io.BytesIO(read_bytes(path)))
    except Exception as error:  # scipy raises many types for damaged files
        raise damaged_file_error(path, error) from None
    values = np.asarray(samples, float).reshape(len(samples), -1)
    if samples.dtype.kind == "u":  # of eight bits
        values = (values - 128) / 128
    elif samples.dtype.kind == "i":  # scipy puts three bytes into the upper ones of four
        values = values / -float(np.iinfo(samples.dtype).min)
    names = ("time", *(f"channel {i + 1}" for i in range(values.shape[1])))
    table = np.column_stack([np.arange(len(values)) / rate, values])
    return {"": LogTable(names, ("s", *[None] * values.shape[1]), table, time="time")}


SOUND = LogFormat("sound", read_wav, suffixes=(".wav",), magics=MAGICS)


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


MINISEED = LogFormat("MiniSEED", read_mseed, suffixes=(".mseed", ".miniseed"), magics=())
