"""Classic netCDF files (netCDF-3); the newer ones are HDF5."""

import re
from pathlib import Path

import numpy as np
from scipy.io import netcdf_file

from tuning.logs.readers.table import (
    LogFormat,
    LogTable,
    damaged_file_error,
    is_time_name,
    table_of,
    text_attribute,
)

MAGIC = b"CDF"
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


FORMAT = LogFormat("netCDF", read_netcdf, suffixes=(".nc",), magics=(MAGIC,))
