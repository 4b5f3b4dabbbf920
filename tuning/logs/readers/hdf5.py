"""HDF5 files, including MATLAB files since version 7.3 and netCDF-4: each group is a run."""

from pathlib import Path

import numpy as np

from jaxbeam.files.endings import import_extra
from tuning.logs.readers.headings import epoch_seconds, is_stamp
from tuning.logs.readers.table import (
    STARTS,
    LogFormat,
    LogTable,
    clocks_by_numbers,
    damaged_file_error,
    table_of,
    text_attribute,
)

MAGIC = b"\x89HDF\r\n\x1a\n"
MATLAB_MAGIC = b"MATLAB 7.3 MAT-file"


def read_hdf5(path: Path) -> dict[str, LogTable]:
    """Tables of an HDF5 file: one run for each group with lists of numbers, by its path.

    Units are the attribute `units` or `unit` of a dataset. Times are a dataset called time, or
    follow from a `sample_rate` or `fs` (Hz), or a `dt` (s), and a `start_time` or `t0` (s): an
    attribute of the dataset, the group or the file, or a number in the group.

    Raises ValueError for a damaged file, ImportError without h5py.
    """
    h5py = import_extra("h5py", "hdf5")
    groups: dict[str, dict] = {}
    units: dict[str, dict] = {}
    given: dict[str, dict] = {}  # numbers that stand for a clock, by group and dataset
    try:
        with h5py.File(path, "r") as file:
            whole = _numbers_of(file.attrs)

            def visit(name, item):
                numeric = isinstance(item, h5py.Dataset) and np.issubdtype(item.dtype, np.number)
                if not numeric or name.startswith("#"):
                    return
                group, _, label = name.rpartition("/")
                if item.size == 1:
                    number = float(np.ravel(item[()])[0])
                    given.setdefault(group, {}).setdefault("", {})[label.lower()] = number
                if item.size < 2:
                    return
                groups.setdefault(group, {})[label] = _numbers(item)
                unit = text_attribute(item.attrs.get("units", item.attrs.get("unit")))
                units.setdefault(group, {})[label] = unit
                own = given.setdefault(group, {})
                own[""] = whole | _numbers_of(item.parent.attrs) | own.get("", {})
                own[label] = _numbers_of(item.attrs)

            file.visititems(visit)
    except Exception as error:  # h5py raises many types for damaged files
        raise damaged_file_error(path, error) from None
    tables = {}
    for group, arrays in groups.items():
        source, numbers = f"{path}, group {group or '/'}", given[group]
        clocks = clocks_by_numbers(
            source, {name: numbers[""] | numbers[name] for name in arrays}, list(arrays)
        )
        tables[group] = table_of(source, arrays, units[group], clocks)
    return tables


def _numbers_of(attributes) -> dict[str, float]:
    """Attributes that are one number, by name in small letters; dates of starts in s."""
    numbers = {}
    for name in attributes:
        value = np.ravel(np.asarray(attributes[name]))
        text = text_attribute(attributes[name])
        if value.size == 1 and value.dtype.kind in "fiu":
            numbers[name.lower()] = float(value[0])
        elif name.lower() in STARTS and text and is_stamp(text):
            numbers[name.lower()] = epoch_seconds(text)
    return numbers


def _numbers(dataset) -> np.ndarray:
    """Numbers of a dataset, scaled as its attributes say, NaN for its fill value."""
    values = np.asarray(dataset[()], float)
    fill = dataset.attrs.get("_FillValue")
    if fill is not None:
        values = np.where(values == np.ravel(fill)[0], np.nan, values)
    own = _numbers_of(dataset.attrs)  # of the CF conventions
    values = values * own.get("scale_factor", 1.0) + own.get("add_offset", 0.0)
    # MATLAB stores vectors as matrices of one column.
    return np.ravel(values) if 1 in values.shape and values.ndim == 2 else values


FORMAT = LogFormat("HDF5", read_hdf5, suffixes=(".h5", ".hdf5"), magics=(MAGIC, MATLAB_MAGIC))
