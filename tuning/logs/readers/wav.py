"""Sound files (.wav), as data loggers write them, too: fractions of a range that the user gives."""

import io
import warnings
from pathlib import Path

import numpy as np
import scipy.io.wavfile

from tuning.logs.readers.table import LogFormat, LogTable, damaged_file_error, read_bytes

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


FORMAT = LogFormat("sound", read_wav, suffixes=(".wav",), magics=MAGICS)
