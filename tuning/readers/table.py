"""What every reader returns: named columns of numbers as read, and the lines they came from."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of a log file, in the units of the file.

    `units` holds the unit of each column as the file names it, or None; `lines` the line number
    of each row. Where the format says which column is time, `time` is its name.
    """

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    values: Float[np.ndarray, "row column"]
    lines: Int[np.ndarray, " row"]
    time: str | None = None


def read_text(path: Path) -> str:
    """Return the text of a file: UTF-8, or the Windows encoding older loggers write.

    Raises ValueError if there is no such file or it is empty.
    """
    if not path.is_file():
        raise ValueError(f"{path}: there is no such log file")
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")
    if not text.strip():
        raise ValueError(f"{path}: the log is empty")
    return text


def numbers(
    path: Path,
    names: Sequence[str],
    rows: Sequence[Sequence[str]],
    lines: Sequence[int],
    decimal_comma: bool,
) -> Float[np.ndarray, "row column"]:
    """Convert the cells of a table, given the line number of each row.

    Raises ValueError naming file, line and column for a cell that is no number.
    """
    if not rows:
        raise ValueError(f"{path}: the log is empty: there are column names but no rows")
    for row, line in zip(rows, lines, strict=True):
        if len(row) != len(names):
            raise ValueError(f"{path}, line {line}: {len(row)} cells for {len(names)} columns")
    if decimal_comma:
        rows = [[cell.replace(",", ".") for cell in row] for row in rows]
    try:
        return np.array(rows, dtype=float)
    except ValueError:
        raise _bad_cell(path, names, rows, lines) from None


def _bad_cell(path, names, rows, lines) -> ValueError:
    """The error for the first cell that is no number."""
    for row, line in zip(rows, lines, strict=True):
        for name, cell in zip(names, row, strict=True):
            try:
                float(cell)
            except ValueError:
                what = f"{cell.strip()!r} is no number" if cell.strip() else "the cell is empty"
                return ValueError(f"{path}, line {line}, column {name!r}: {what}")
    raise AssertionError("numpy refused what Python reads as numbers")
