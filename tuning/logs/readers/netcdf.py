"""Classic netCDF files (netCDF-3); the newer ones are HDF5."""

from pathlib import Path

import numpy as np
from scipy.io import netcdf_file

from tuning.logs.readers.table import (
    LogFormat,
    LogTable,
    damaged_file_error,
    table_of,
    text_attribute,
)

MAGIC = b"CDF"


def read_netcdf(path: Path) -> dict[str, LogTable]:
    """Table of a classic netCDF file: one run, of the variables that are as long as the times.

    Units are the attribute `units`. Raises ValueError for a damaged file.
    """
    try:
        with netcdf_file(path, "r", mmap=False) as file:
            arrays, units = {}, {}
            for name, variable in file.variables.items():
                # Text is an array of characters.
                if variable.typecode() != "c" and np.size(variable.data) > 1:
                    arrays[name] = np.array(variable.data, float)
                    units[name] = text_attribute(getattr(variable, "units", None))
    except Exception as error:  # scipy raises many types for damaged files
        raise damaged_file_error(path, error) from None
    return {"": table_of(str(path), arrays, units)}


FORMAT = LogFormat("netCDF", read_netcdf, suffixes=(".nc",), magics=(MAGIC,))
