"""MATLAB files up to version 7; since 7.3 they are HDF5."""

from pathlib import Path

import numpy as np
from scipy.io import loadmat, matlab

from tuning.logs.clocks import clocks_by_numbers
from tuning.logs.readers.mat_elements import check_elements
from tuning.logs.readers.table import (
    LogFormat,
    LogTable,
    damaged_file_error,
    read_bytes,
    table_of,
)

MAGIC = b"MATLAB 5.0 MAT-file"


def read_mat(path: Path) -> dict[str, LogTable]:
    """Tables of a MATLAB file: a run of its variables, and one for each struct of vectors.

    A struct `units` within a run has the units of its variables. Without a variable of times, one
    number `fs` (Hz) or `dt` (s) beside them says how they are sampled. The entries of an array of
    structs are runs `name.0`, `name.1`, ... Other scalars and text are left out.

    Raises ValueError for a damaged file, or one that holds objects only (such as a timetable).
    """
    try:
        check_elements(read_bytes(path))
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except Exception as error:  # scipy raises many types for damaged files
        raise damaged_file_error(path, error) from None
    content = {name: value for name, value in content.items() if not name.startswith("__")}
    runs = {"": content}
    for name, value in content.items():
        if isinstance(value, matlab.mat_struct) and name != "units":
            runs[name] = _fields(value)
        elif isinstance(value, np.ndarray) and value.dtype == object:
            structs = [entry for entry in value.flat if isinstance(entry, matlab.mat_struct)]
            runs |= {f"{name}.{i}": _fields(entry) for i, entry in enumerate(structs)}
    tables = {}
    for name, fields in runs.items():
        arrays = {a: v for a, v in fields.items() if _is_numeric_array(v)}
        if arrays:
            units = _fields(fields["units"]) if "units" in fields else {}
            source = f"{path}, {name}" if name else str(path)
            numbers = _scalars(content) | _scalars(fields)
            clocks = clocks_by_numbers(source, dict.fromkeys(arrays, numbers), list(arrays))
            tables[name] = table_of(source, arrays, units, clocks)
    if not tables:
        raise ValueError(
            f"{path}: there is no list of numbers in it; tables and timetables are objects that "
            "only MATLAB reads: save their columns as vectors, or write them as CSV"
        )
    return tables


def _fields(struct) -> dict:
    named = isinstance(struct, matlab.mat_struct)
    return {name: getattr(struct, name) for name in struct._fieldnames} if named else {}


def _scalars(fields) -> dict[str, float]:
    """Single numbers by name in small letters, as `fs`."""
    numbers = {name.lower(): value for name, value in fields.items() if np.size(value) == 1}
    return {
        name: float(value)
        for name, value in numbers.items()
        if isinstance(value, int | float | np.number)
    }


def _is_numeric_array(value) -> bool:
    return isinstance(value, np.ndarray) and value.size > 1 and value.dtype.kind in "fiub"


FORMAT = LogFormat("MATLAB", read_mat, suffixes=(".mat",), magics=(MAGIC,))
