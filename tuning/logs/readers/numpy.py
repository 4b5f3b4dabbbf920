"""Arrays of NumPy (.npy, .npz): a table, a structured array, or an archive of arrays."""

import io
from pathlib import Path

import numpy as np

from tuning.logs.readers.headings import unnamed
from tuning.logs.readers.table import (
    LogFormat,
    LogTable,
    clocks_by_numbers,
    damaged_file_error,
    read_bytes,
    table_of,
    upright,
)

MAGICS = (b"\x93NUMPY", b"PK\x03\x04")  # of one array, and of an archive of them


def read_numpy(path: Path) -> dict[str, LogTable]:
    """Table of the arrays in a file of NumPy.

    Arrays of an archive are columns by their names, which may be headings with units; one number
    `fs` (Hz) or `dt` (s) among them says how they are sampled. So are the fields of a structured
    array. Columns of another array are named by the user.

    Raises ValueError for a damaged file, and for one without numbers.
    """
    try:
        found = np.load(io.BytesIO(read_bytes(path)), allow_pickle=False)
        named = {"": found} if isinstance(found, np.ndarray) else dict(found)
    except Exception as error:  # zip files raise many types
        raise damaged_file_error(path, error) from None
    array = named.get("")
    if array is not None and array.dtype.names is None:
        if array.dtype.kind not in "fiub" or array.ndim not in (1, 2):
            raise ValueError(f"{path}: the array should be a table of numbers, not {array.shape}")
        table = upright(np.asarray(array, float).reshape(len(array), -1))
        names = unnamed(table.shape[1])
        return {"": LogTable(names, (None,) * len(names), table, has_headings=False)}
    if array is not None:
        named = {name: array[name] for name in array.dtype.names}
    numeric = {name: own for name, own in named.items() if own.dtype.kind in "fiub"}
    numbers = {name.lower(): float(own.item()) for name, own in numeric.items() if own.size == 1}
    arrays = {name: own for name, own in numeric.items() if own.size > 1}
    clocks = clocks_by_numbers(str(path), dict.fromkeys(arrays, numbers), list(arrays))
    return {"": table_of(str(path), arrays, {}, clocks)}


FORMAT = LogFormat("NumPy", read_numpy, suffixes=(".npy", ".npz"), magics=MAGICS)
