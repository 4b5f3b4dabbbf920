"""Tables of records and sweeps: CSV, Excel, MATLAB and Parquet; state-space matrices as files.

A cell that begins with = + - @, a tab or a line break is a formula, or may become one, to Excel,
LibreOffice and Google Sheets, in .csv files as in .xlsx. An apostrophe before it makes it text
("CSV Injection", OWASP); also behind a semicolon, tab or line break, as where the comma is the
decimal mark these separate cells.
"""

import csv
import itertools
import json
import os
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxbeam.case.case import Case, address_words, unit_at
from jaxbeam.case.fields import refuses_traced
from jaxbeam.case.sensors import sensor_labels
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.model.state_space import StateSpace
from jaxbeam.runtime.output_file import DATASETS, RESULTS, TABLES, check_ending, whole_file

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX


_START = r"(^|[;\t\r\n])"
_FORMULA = re.compile(_START + r"(?='*[=+\-@\t\r\n＝＋－＠﹢﹣﹦﹫])")
_AS_TEXT = re.compile(_START + r"'(?='*[=+\-@\t\r\n＝＋－＠﹢﹣﹦﹫])")


def as_text_cell(text: str) -> str:
    """Text of a cell that no spreadsheet runs; `from_text_cell` restores it.

    >>> as_text_cell("=1+1"), as_text_cell("midspan")
    ("'=1+1", 'midspan')
    """
    return _FORMULA.sub(r"\1'", text)


def from_text_cell(cell: str) -> str:
    """Original text of a cell that `as_text_cell` returned.

    >>> from_text_cell("'=1+1"), from_text_cell("'t Zand")
    ('=1+1', "'t Zand")
    """
    return _AS_TEXT.sub(r"\1", cell)


Columns = Mapping[str, np.ndarray]  # equally long, of numbers or texts, by their heads
MAX_EXCEL_ROWS = 1_048_575  # below the heads


@refuses_traced("a file")
def save(result: Any, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a result to a file: a record, modes, frequency responses, an envelope, a sweep, a fit.

    The ending decides: .nc and .zarr hold its dataset, with units and coordinates; .csv (UTF-8, all
    digits), .xlsx, .mat and .parquet its `columns`, with units in their heads (`write_table`); a
    text that a spreadsheet would run as a formula has an apostrophe before it in the first two. Of
    a sweep, a row for each run (`sweep_columns`). What has no dataset, as a fit, is written as a
    table alone. Raises FileExistsError if the
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
    has_dataset = hasattr(result, "data_vars") or hasattr(result, "to_xarray")
    check_ending(path, "a result", RESULTS if has_dataset else TABLES)
    if hasattr(result, "data_vars"):  # the dataset of a sweep
        columns = sweep_columns(result) if path.suffix in TABLES else {}
        write_result(path, lambda: columns, lambda: result, overwrite)
    else:
        write_result(path, lambda: result.columns, lambda: result.to_xarray(), overwrite)


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
    with whole_file(path, overwrite) as partial:
        _write_dataset(partial, dataset)


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
    with whole_file(path, overwrite) as partial:
        WRITERS[partial.suffix](partial, plain)


def _plain(column) -> np.ndarray:
    """A column as floats, or as objects if it holds texts."""
    column = np.asarray(column)
    return column.astype(object) if column.dtype.kind in "UO" else column.astype(float)


def _write_dataset(partial: Path, dataset: "xarray.Dataset") -> None:
    # Empty dimensions would become unlimited ones in a file.
    empty = [name for name in dataset.variables if dataset[name].size == 0]
    dataset = dataset.drop_vars(empty)
    if partial.suffix == ".nc":
        dataset.to_netcdf(partial, engine="scipy")
        return
    # Zarr specifies strings of variable length, not of fixed length.
    texts = {
        name: (values.dims, values.values.astype(object), values.attrs)
        for name, values in dataset.variables.items()
        if values.dtype.kind == "U"
    }
    dataset.assign(texts).to_zarr(partial, mode="w", consolidated=False, zarr_format=3)


def _write_csv(partial: Path, columns: Columns) -> None:
    with partial.open("w", encoding="utf-8", newline="") as file:
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


def _write_excel(partial: Path, columns: Columns) -> None:
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
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        ExcelWriter(book, archive).save()


def _excel_cell(cell: Any) -> Any:
    """A number, None if it is not finite, or a text, without the ends of lines that XML changes."""
    if isinstance(cell, str):
        return cell.replace("\r", "_x000D_")  # as Office Open XML (ISO 29500) writes them
    return cell if np.isfinite(cell) else None


def _write_matlab(partial: Path, columns: Columns) -> None:
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
    scipy.io.savemat(partial, content)


def _write_parquet(partial: Path, columns: Columns) -> None:
    import pyarrow.parquet

    pyarrow.parquet.write_table(pyarrow.table(dict(columns)), partial)


WRITERS: dict[str, Callable[[Path, Columns], None]] = {
    ".csv": _write_csv,
    ".xlsx": _write_excel,
    ".mat": _write_matlab,
    ".parquet": _write_parquet,
}


MAX_LOADS = 8  # wheels with a column each; of more the least contact force of all


def sweep_columns(dataset: "xarray.Dataset") -> dict[str, np.ndarray]:
    """Columns of the dataset of a sweep by head, as "speed of the load (m/s)"; a row for each run.

    Swept values, peaks of all sensors with their times, smallest contact forces in N, and whether
    the run failed (1) or not (0); histories are left out. `pandas.DataFrame(columns)` works. Raises
    ValueError for a dataset that is not that of a sweep.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingForce(force=5.0, speed=2.0)]
    ... )
    >>> runs = jb.sweep(case, {"loads.0.speed": [1.0, 2.0]}, progress=False)
    >>> print(next(iter(sweep_columns(runs))))
    speed of the load (m/s)
    """
    if "failed" not in dataset or "case" not in dataset.attrs:
        raise ValueError("not a sweep of jaxbeam: the dataset lacks its runs or its case")
    case = case_from_dict(json.loads(dataset.attrs["case"]))
    failed = dataset["failed"]

    def of_runs(values: "xarray.DataArray") -> np.ndarray:
        return values.broadcast_like(failed).transpose(*failed.dims).values.ravel()

    names = dict.fromkeys([*map(str, failed.dims), *map(str, dataset.coords)])
    columns = {
        _head(case, name): of_runs(dataset[name])
        for name in names
        if "." in name and name in dataset.coords
    }
    labels = [str(label) for label in np.atleast_1d(dataset["sensor"].values)]
    for i, label in enumerate(labels):
        sensor = case.sensors[sensor_labels(case.sensors).index(label)]
        name = sensor.name or f"sensor {label.partition(':')[0]}"
        peak, time = f"peak_{sensor.quantity}", "peak_time"
        words = f"{name} peak {sensor.quantity}"
        columns[words + _in_brackets(sensor.unit)] = of_runs(_entry(dataset[peak], "sensor", i))
        columns[f"time of {words} (s)"] = of_runs(_entry(dataset[time], "sensor", i))
    for i in range(dataset.sizes.get("absorber", 0)):
        for words, name in (("stroke (m)", "peak_stroke"), ("force (N)", "peak_absorber_force")):
            peaks = of_runs(dataset[name].isel(absorber=i))
            columns[f"absorber {i} peak {words}"] = peaks
    forces = dataset.get("lowest_contact_force", None)
    if forces is not None and "load" in forces.dims and 0 < forces.sizes["load"] <= MAX_LOADS:
        for i in range(forces.sizes["load"]):
            columns[f"load {i} lowest contact force (N)"] = of_runs(forces.isel(load=i))
    elif forces is not None and forces.size:
        columns["lowest contact force (N)"] = of_runs(forces.min("load"))
    return columns | {"failed": of_runs(failed)}


def _entry(values: "xarray.DataArray", dim: str, index: int) -> "xarray.DataArray":
    return values.isel({dim: index}) if dim in values.dims else values


def _head(case: Case, address: str) -> str:
    try:
        unit = unit_at(case, address)
    except ValueError:  # a word has no unit
        unit = ""
    return address_words(case, address) + _in_brackets(unit)


def _in_brackets(unit: str) -> str:
    return "" if unit in ("", "1") else f" ({unit})"


MATRIX_SUFFIXES = (".mat", ".npz", ".json", ".csv")


def matrices_of(system: StateSpace) -> dict[str, Any]:
    """A, B, C and D as nested lists, names and units of all signals, and the period (s; 0 if none).

    Numbers are in SI units, by the names that `write_state_space` gives them.
    """
    content: dict[str, Any] = {name: np.asarray(getattr(system, name)).tolist() for name in "ABCD"}
    for kind in ("states", "inputs", "outputs"):
        signals = getattr(system, kind)
        content[kind] = [signal.name for signal in signals]
        content[f"{kind}_units"] = [signal.unit for signal in signals]
    return content | {"period": 0.0 if system.period is None else float(system.period)}


def write_state_space(system: StateSpace, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a linear system to a file: its matrices, and names and units of its signals.

    The ending decides: .mat (MATLAB, version 5), .npz (NumPy), .json, .csv: one table, a row for
    the rate of each state and for each output, a column for each state and each input. Raises
    ValueError for another ending, FileExistsError if the file exists, without `overwrite`.
    """
    path = Path(path)
    if path.suffix not in MATRIX_SUFFIXES:
        raise ValueError(f"{path}: matrices are written to a file of {', '.join(MATRIX_SUFFIXES)}")
    if path.suffix == ".mat":
        system.to_mat(path, overwrite)
        return
    content = matrices_of(system)
    with whole_file(path, overwrite) as partial:
        if path.suffix == ".npz":
            np.savez(partial, **{name: np.asarray(part) for name, part in content.items()})
        elif path.suffix == ".json":
            partial.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        else:
            _write_matrices_csv(system, partial)


def _write_matrices_csv(system: StateSpace, path: Path) -> None:
    def names(signals, words=""):
        return [f"{words}{signal.name} ({signal.unit})" for signal in signals]

    step = "rate of " if system.period is None else "next "
    heads = ["", *names(system.states), *names(system.inputs)]
    rows = np.block(
        [
            [np.asarray(part) for part in pair]
            for pair in ((system.A, system.B), (system.C, system.D))
        ]
    )
    labels = [*(f"{step}{signal.name}" for signal in system.states), *names(system.outputs)]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(map(as_text_cell, heads))
        named = zip(map(as_text_cell, labels), rows.tolist(), strict=True)
        writer.writerows([label, *row] for label, row in named)
