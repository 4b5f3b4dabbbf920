"""HDF5 files, including MATLAB files since version 7.3 and netCDF-4: each group is a run."""

from pathlib import Path

import numpy as np

from tuning.logs.readers.table import (
    LogFormat,
    LogTable,
    damaged_file_error,
    table_of,
    text_attribute,
)
from tuning.optional import import_extra

MAGIC = b"\x89HDF\r\n\x1a\n"
MATLAB_MAGIC = b"MATLAB 7.3 MAT-file"
_RATES = ("sample_rate", "sampling_rate", "fs")


def read_hdf5(path: Path) -> dict[str, LogTable]:
    """Tables of an HDF5 file: one run for each group with lists of numbers, by its path.

    Units are the attribute `units` or `unit` of a dataset. Times are a dataset called time, or
    follow from an attribute `sample_rate` (Hz) of the group or the file.

    Raises ValueError for a damaged file, ImportError without h5py.
    """
    h5py = import_extra("h5py", "hdf5")
    groups: dict[str, dict] = {}
    units: dict[str, dict] = {}
    rates = {}
    try:
        with h5py.File(path, "r") as file:

            def visit(name, item):
                numeric = isinstance(item, h5py.Dataset) and np.issubdtype(item.dtype, np.number)
                if not numeric or item.size < 2 or name.startswith("#"):
                    return
                group, _, label = name.rpartition("/")
                groups.setdefault(group, {})[label] = _numbers(item)
                units.setdefault(group, {})[label] = _unit(item)
                rates[group] = _sample_rate(item.parent) or _sample_rate(file)

            file.visititems(visit)
    except Exception as error:  # h5py raises many types for damaged files
        raise damaged_file_error(path, error) from None
    return {
        group: table_of(
            f"{path}, group {group or '/'}", arrays, units[group], _times_function(rates[group])
        )
        for group, arrays in groups.items()
    }


def _numbers(dataset) -> np.ndarray:
    """Numbers of a dataset, NaN for its fill value."""
    values = np.asarray(dataset[()], float)
    fill = dataset.attrs.get("_FillValue")
    if fill is not None:
        values = np.where(values == np.ravel(fill)[0], np.nan, values)
    # MATLAB stores vectors as matrices of one column.
    return np.ravel(values) if 1 in values.shape and values.ndim == 2 else values


def _unit(dataset) -> str | None:
    return text_attribute(dataset.attrs.get("units", dataset.attrs.get("unit")))


def _sample_rate(group) -> float | None:
    found = [group.attrs[name] for name in _RATES if name in group.attrs]
    return float(np.ravel(found[0])[0]) if found else None


def _times_function(rate: float | None):
    return None if rate is None else lambda count: np.arange(count) / rate


FORMAT = LogFormat("HDF5", read_hdf5, suffixes=(".h5", ".hdf5"), magics=(MAGIC, MATLAB_MAGIC))
