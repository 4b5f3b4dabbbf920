"""Parquet files, by pyarrow."""

from pathlib import Path

import numpy as np

from jaxbeam.files.endings import import_extra
from tuning.logs.readers.table import (
    LogFormat,
    LogTable,
    damaged_file_error,
    table_of,
    text_attribute,
)

MAGIC = b"PAR1"


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


FORMAT = LogFormat("Parquet", read_parquet, suffixes=(".parquet",), magics=(MAGIC,))
