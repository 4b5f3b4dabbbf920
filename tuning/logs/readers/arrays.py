"""Named arrays: HDF5 with newer MATLAB and netCDF files, classic netCDF, NumPy, Parquet."""

import io
import re
from pathlib import Path

import numpy as np
from scipy.io import netcdf_file

from jaxbeam.runtime.packages import import_extra
from tuning.logs.readers.headings import epoch_seconds, is_stamp, unnamed
from tuning.logs.readers.table import (
    STARTS,
    LogFormat,
    LogTable,
    clocks_by_numbers,
    damaged_file_error,
    is_time_name,
    read_bytes,
    table_of,
    text_attribute,
    upright,
)

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
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


HDF5 = LogFormat("HDF5", read_hdf5, suffixes=(".h5", ".hdf5"), magics=(HDF5_MAGIC, MATLAB_MAGIC))


NETCDF_MAGIC = b"CDF"
TIME_UNITS = {"second": "s", "sec": "s", "millisecond": "ms", "microsecond": "us", "minute": "min"}
_SINCE = re.compile(rf"((?:{'|'.join(TIME_UNITS)})s?) since .+")


def read_netcdf(path: Path) -> dict[str, LogTable]:
    """Table of a classic netCDF file: a run of the variables along each dimension of times.

    Units are the attribute `units`; times since a date (CF conventions) are seconds from the first.
    Raises ValueError for a damaged file.
    """
    runs: dict[str, dict] = {}
    units: dict[str, str | None] = {}
    try:
        with netcdf_file(path, "r", mmap=False, maskandscale=True) as file:
            for name, variable in file.variables.items():
                # Text is an array of characters.
                if variable.typecode() == "c" or not variable.dimensions:
                    continue
                values = np.ma.filled(np.ma.masked_invalid(variable[:].astype(float)), np.nan)
                if values.size > 1:
                    runs.setdefault(variable.dimensions[0], {})[name] = values
                    units[name] = text_attribute(getattr(variable, "units", None))
    except Exception as error:  # scipy raises many types for damaged files
        raise damaged_file_error(path, error) from None
    runs = _along_times(runs, units)
    tables = {}
    for dimension, arrays in runs.items():
        source = f"{path}, dimension {dimension!r}" if len(runs) > 1 else str(path)
        tables[dimension] = table_of(source, *_without_epochs(arrays, units))
    return tables if len(tables) != 1 else {"": next(iter(tables.values()))}


def _along_times(runs: dict[str, dict], units: dict[str, str | None]) -> dict[str, dict]:
    """Runs that have times: of variables along other dimensions these are not the times."""
    with_times = {
        dimension: arrays
        for dimension, arrays in runs.items()
        if any(is_time_name(name, units.get(name)) for name in (dimension, *arrays))
    }
    return with_times or runs


def _without_epochs(arrays, units) -> tuple[dict, dict]:
    """Arrays and units in which times since a date are times since the first."""
    arrays, units = dict(arrays), {name: units[name] for name in arrays}
    for name, unit in units.items():
        found = _SINCE.fullmatch(unit or "")
        if found:
            arrays[name] = arrays[name] - arrays[name][0]
            units[name] = TIME_UNITS[found[1].rstrip("s")]
    return arrays, units


NETCDF = LogFormat("netCDF", read_netcdf, suffixes=(".nc",), magics=(NETCDF_MAGIC,))


NUMPY_MAGICS = (b"\x93NUMPY", b"PK\x03\x04")  # of one array, and of an archive of them


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


NUMPY = LogFormat("NumPy", read_numpy, suffixes=(".npy", ".npz"), magics=NUMPY_MAGICS)


PARQUET_MAGIC = b"PAR1"


def read_parquet(path: Path) -> dict[str, LogTable]:
    """Table of a Parquet file: one run of its columns of numbers.

    Units stand in brackets after names, or in the metadata `unit` of a column. A column of dates
    becomes seconds since the first; null becomes NaN, a missing sample.

    Raises ValueError for a damaged file, ImportError without pyarrow.
    """
    pyarrow = import_extra("pyarrow", "parquet")
    parquet = import_extra("pyarrow.parquet", "parquet")
    try:
        table = parquet.read_table(path)
    except (OSError, pyarrow.ArrowException) as error:
        raise damaged_file_error(path, error) from None
    arrays, units = {}, {}
    for field in table.schema:
        values = table[field.name].to_numpy()
        if values.dtype.kind == "M":
            values = (values - values[0]) / np.timedelta64(1, "s")
            units[field.name] = "s"
        if values.dtype.kind in "fiu":
            arrays[field.name] = values
            units.setdefault(field.name, text_attribute((field.metadata or {}).get(b"unit")))
    return {"": table_of(str(path), arrays, units)}


PARQUET = LogFormat("Parquet", read_parquet, suffixes=(".parquet",), magics=(PARQUET_MAGIC,))
