"""Tables of numbers as files for other programs: CSV, Excel, MATLAB and Parquet, by their ending.

A file is written beside its place and then moved there, so that none is ever half written.
"""

import importlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

Columns = Mapping[str, Float[np.ndarray, " row"]]
MAX_EXCEL_ROWS = 1_048_575  # below the heads


def write_table(path: str | os.PathLike, columns: Columns, overwrite: bool = False) -> None:
    """Write equally long columns of numbers by their heads, as "midspan deflection (m)".

    The ending decides: .csv (UTF-8, all digits), .xlsx (needs openpyxl), .mat (the matrix `values`
    with the heads `columns`), .parquet (needs pyarrow). Raises FileExistsError if the file exists,
    without `overwrite`; ValueError for another ending or too many rows for Excel; ImportError, with
    what to install, if a package is missing.
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise ValueError(f"{path}: a table is written to a file of {', '.join(WRITERS)}")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists already; choose another name, or overwrite it")
    beside = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        WRITERS[path.suffix](beside, {head: np.asarray(c, float) for head, c in columns.items()})
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def _needed(package: str, ending: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError:
        name = package.partition(".")[0]
        raise ImportError(
            f"{ending} files need {name}, which is not installed: pip install {name}, or"
            " 'jaxbeam[tables]'"
        ) from None


def _write_csv(path: Path, columns: Columns) -> None:
    import csv

    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(np.stack(list(columns.values()), axis=-1).tolist())


def _write_excel(path: Path, columns: Columns) -> None:
    rows = np.stack(list(columns.values()), axis=-1)
    if len(rows) > MAX_EXCEL_ROWS:
        raise ValueError(
            f"{len(rows)} rows are more than the {MAX_EXCEL_ROWS} of Excel: write .csv or .parquet"
        )
    book = _needed("openpyxl", ".xlsx").Workbook(write_only=True)
    sheet = book.create_sheet("jaxbeam")
    sheet.append(list(columns))
    for row in rows.tolist():
        sheet.append([value if np.isfinite(value) else None for value in row])
    book.save(path)


def _write_matlab(path: Path, columns: Columns) -> None:
    import scipy.io

    heads = np.array(list(columns), dtype=object)
    scipy.io.savemat(path, {"columns": heads, "values": np.stack(list(columns.values()), axis=-1)})


def _write_parquet(path: Path, columns: Columns) -> None:
    arrow = _needed("pyarrow", ".parquet")
    _needed("pyarrow.parquet", ".parquet").write_table(arrow.table(dict(columns)), path)


WRITERS: dict[str, Callable[[Path, Columns], None]] = {
    ".csv": _write_csv,
    ".xlsx": _write_excel,
    ".mat": _write_matlab,
    ".parquet": _write_parquet,
}
