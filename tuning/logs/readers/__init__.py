"""One file per format of a log; each turns a file into the same plain tables, one for each run."""

from pathlib import Path

from tuning.logs.readers import hdf5, lvm, mat, netcdf, parquet, tdms
from tuning.logs.readers.csv import read_csv
from tuning.logs.readers.lvm import read_lvm
from tuning.logs.readers.table import LogTable, is_time_name, read_bytes

__all__ = ["LogTable", "is_time_name", "read_tables"]

# What a file starts with, and who reads it.
_READER_OF_MAGIC = (
    (tdms.MAGIC, tdms.read_tdms),
    (hdf5.MAGIC, hdf5.read_hdf5),
    (hdf5.MATLAB_MAGIC, hdf5.read_hdf5),
    (mat.MAGIC, mat.read_mat),
    (netcdf.MAGIC, netcdf.read_netcdf),
    (parquet.MAGIC, parquet.read_parquet),
)
_BINARY_FORMATS = {
    ".tdms": "LabVIEW (TDMS)",
    ".mat": "MATLAB",
    ".h5": "HDF5",
    ".hdf5": "HDF5",
    ".nc": "netCDF",
    ".parquet": "Parquet",
}
_TEXT_SUFFIXES = (".csv", ".tsv", ".txt", ".dat")


def read_tables(path: Path) -> dict[str, LogTable]:
    """Read the runs in a file, by name; "" is the name of one that has none.

    What a file is, its content tells, whatever it is called; only text goes by the suffix.
    Raises ValueError if it is of no known kind, damaged or empty, ImportError if a library is
    missing that reads it.
    """
    start = read_bytes(path, 128)
    suffix = path.suffix.lower()
    for magic, read in _READER_OF_MAGIC:
        if start.startswith(magic):
            tables = read(path)
            if not tables:
                raise ValueError(f"{path}: the log is empty: there are no lists of numbers in it")
            return tables
    if start.lstrip(b"\xef\xbb\xbf").startswith(lvm.MAGIC.encode()) or suffix == ".lvm":
        return {"": read_lvm(path)}
    if suffix in _BINARY_FORMATS:
        raise ValueError(
            f"{path}: this is no {_BINARY_FORMATS[suffix]} file, whatever it is called: it starts with "
            f"{start[:8]!r}"
        )
    if suffix in _TEXT_SUFFIXES:
        return {"": read_csv(path)}
    known = ", ".join((*_TEXT_SUFFIXES, ".lvm", *_BINARY_FORMATS))
    raise ValueError(f"{path}: unknown kind of log {path.suffix!r}; known are {known}")
