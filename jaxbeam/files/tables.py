"""Results as files for other programs, by their ending: tables of columns, and whole datasets."""

import itertools
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxbeam.files.endings import DATASETS, RESULTS, TABLES, check_ending
from jaxbeam.files.spreadsheet import as_text_cell
from jaxbeam.runtime.whole_file import whole_file

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

Columns = Mapping[str, np.ndarray]  # equally long, of numbers or texts, by their heads
MAX_EXCEL_ROWS = 1_048_575  # below the heads


def save(result: Any, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a result to a file: a record, modes, frequency responses, an envelope, a sweep.

    The ending decides: .nc and .zarr hold its dataset, with units and coordinates; .csv (UTF-8, all
    digits), .xlsx, .mat and .parquet its `columns`, with units in their heads (`write_table`); a
    text that a spreadsheet would run as a formula has an apostrophe before it in the first two. Of
    a sweep, a row for each run (`files.sweep_table.sweep_columns`). Raises FileExistsError if the
    file exists, without `overwrite`; ValueError for another ending; ImportError, with what to
    install, if a package is missing.

    >>> import tempfile, pathlib, jaxbeam as jb
    >>> case = jb.Case(jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535))
    >>> path = pathlib.Path(tempfile.mkdtemp(), "modes.csv")
    >>> jb.save(jb.modes(case), path)
    >>> print(path.read_text().splitlines()[0])
    mode,frequency (Hz),damping ratio
    """
    path = Path(path)
    check_ending(path, "a result", RESULTS)
    if hasattr(result, "data_vars"):  # the dataset of a sweep
        from jaxbeam.files.sweep_table import sweep_columns

        columns = sweep_columns(result) if path.suffix in TABLES else {}
        write_result(path, lambda: columns, lambda: result, overwrite)
    else:
        write_result(path, lambda: result.columns, result.to_xarray, overwrite)


def write_result(
    path: str | os.PathLike,
    columns: Callable[[], Columns],
    dataset: "Callable[[], xarray.Dataset]",
    overwrite: bool = False,
) -> None:
    """Write columns or a dataset, whichever the ending asks for; see `save` for what is raised."""
    if Path(path).suffix in DATASETS:
        write_dataset(path, dataset(), overwrite)
    else:
        write_table(path, columns(), overwrite)


def write_dataset(
    path: str | os.PathLike, dataset: "xarray.Dataset", overwrite: bool = False
) -> None:
    """Write a labelled dataset to .nc or .zarr; see `save` for what is raised."""
    check_ending(path, "a dataset", DATASETS)
    with whole_file(path, overwrite) as beside:
        _write_dataset(beside, dataset)


def write_table(path: str | os.PathLike, columns: Columns, overwrite: bool = False) -> None:
    """Write equally long columns by their heads, as "midspan deflection (m)".

    The ending decides: .csv (UTF-8, all digits), .xlsx (needs openpyxl), .mat (the matrix `values`
    with the heads `columns`; columns of texts as cells in `texts` with heads `text_columns`),
    .parquet (needs pyarrow). Raises as `save` does, and ValueError for columns of different lengths
    or too many rows for Excel.
    """
    check_ending(path, "a table", TABLES)
    plain = {head: _plain(column) for head, column in columns.items()}
    lengths = {column.size for column in plain.values()}
    if len(lengths) > 1:
        raise ValueError(f"the columns of a table must be equally long, not {sorted(lengths)}")
    with whole_file(path, overwrite) as beside:
        WRITERS[beside.suffix](beside, plain)


def _plain(column) -> np.ndarray:
    """A column as floats, or as objects if it holds texts."""
    column = np.asarray(column)
    return column.astype(object) if column.dtype.kind in "UO" else column.astype(float)


def _write_dataset(beside: Path, dataset: "xarray.Dataset") -> None:
    # Empty dimensions would become unlimited ones in a file.
    empty = [name for name in dataset.variables if dataset[name].size == 0]
    dataset = dataset.drop_vars(empty)
    if beside.suffix == ".nc":
        dataset.to_netcdf(beside, engine="scipy")
        return
    # Zarr specifies strings of variable length, not of fixed length.
    texts = {
        name: (values.dims, values.values.astype(object), values.attrs)
        for name, values in dataset.variables.items()
        if values.dtype.kind == "U"
    }
    dataset.assign(texts).to_zarr(beside, mode="w", consolidated=False, zarr_format=3)


def _write_csv(beside: Path, columns: Columns) -> None:
    import csv

    with beside.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(map(as_text_cell, columns))
        writer.writerows(_rows(columns))


def _rows(columns: Columns) -> Any:
    """Rows of cells for a spreadsheet."""
    cells = (
        map(_text_or_number, column) if column.dtype == object else column.tolist()
        for column in columns.values()
    )
    return zip(*cells, strict=True)


def _text_or_number(cell: Any) -> Any:
    return as_text_cell(cell) if isinstance(cell, str) else cell


def _write_excel(beside: Path, columns: Columns) -> None:
    import openpyxl
    from openpyxl.writer.excel import ExcelWriter

    count = max((column.size for column in columns.values()), default=0)
    if count > MAX_EXCEL_ROWS:
        raise ValueError(
            f"{count} rows are more than the {MAX_EXCEL_ROWS} of Excel: write .csv or .parquet"
        )
    book = openpyxl.Workbook(write_only=True)
    sheet = book.create_sheet("jaxbeam")
    for row in itertools.chain([map(as_text_cell, columns)], _rows(columns)):
        sheet.append([_excel_cell(cell) for cell in row])
    # `book.save` leaves a file open that it cannot write.
    with zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED) as archive:
        ExcelWriter(book, archive).save()


def _excel_cell(cell: Any) -> Any:
    """A number, None if it is not finite, or a text, without the ends of lines that XML changes."""
    if isinstance(cell, str):
        return cell.replace("\r", "_x000D_")  # as Office Open XML (ISO 29500) writes them
    return cell if np.isfinite(cell) else None


def _write_matlab(beside: Path, columns: Columns) -> None:
    import scipy.io

    texts = {head: column for head, column in columns.items() if column.dtype == object}
    numbers = {head: column for head, column in columns.items() if head not in texts}
    content = {
        "columns": np.array(list(numbers), dtype=object),
        "values": np.stack(list(numbers.values()), axis=-1),
    }
    if texts:
        content["text_columns"] = np.array(list(texts), dtype=object)
        content["texts"] = np.stack(list(texts.values()), axis=-1)
    scipy.io.savemat(beside, content)


def _write_parquet(beside: Path, columns: Columns) -> None:
    import pyarrow.parquet

    pyarrow.parquet.write_table(pyarrow.table(dict(columns)), beside)


WRITERS: dict[str, Callable[[Path, Columns], None]] = {
    ".csv": _write_csv,
    ".xlsx": _write_excel,
    ".mat": _write_matlab,
    ".parquet": _write_parquet,
}
