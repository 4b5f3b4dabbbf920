"""What every reader returns: named columns of numbers as read, and the lines they came from."""

import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

_HEADING = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\[\]()]*)[\])]$")
TIME_NAMES = ("time", "t", "zeit", "temps", "x_value")


@dataclass(frozen=True, eq=False)
class LogTable:
    """Columns of one run in a log file, in the units of the file.

    `units` holds the unit of each column as the file names it, or None; `lines` the line number
    of each row, None where the file has no lines. Where the format says which column is time,
    `time` is its name. `notes` say what is to be known of how it was read, in a sentence each.
    """

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    values: Float[np.ndarray, "row column"]
    lines: Int[np.ndarray, " row"] | None = None
    time: str | None = None
    notes: tuple[str, ...] = ()


def parse_heading(text: str) -> tuple[str, str | None]:
    """The name and unit in the heading of a column, such as `d1 [mm]`; None without a unit."""
    found = _HEADING.match(text.strip())
    return (found["name"], found["unit"]) if found else (text.strip(), None)


def table_of(
    source: str,
    arrays: Mapping[str, Any],
    units: Mapping[str, str | None],
    times_function: Callable[[int], np.ndarray] | None = None,
    notes: Sequence[str] = (),
) -> LogTable:
    """A table of the arrays of one run, by name; a name may be a heading with a unit.

    An array of several columns becomes `name.0`, `name.1`, ... What is not as long as the times
    (else as most of the arrays) is left out, which a note says. `times_function` gives the times (s) of so
    many samples, for a run that has no column of them.

    Raises ValueError if there are no numbers.
    """
    arrays = {name: np.asarray(array, float) for name, array in arrays.items()}
    length = _length(arrays)
    if length < 2:
        raise ValueError(f"{source}: there is no list of numbers in it")
    names, found, columns, left_out = [], [], [], []
    for label, array in arrays.items():
        if length not in array.shape or array.ndim > 2:
            left_out.append(label)
            continue
        name, unit = parse_heading(label)
        flat = array.reshape(length, -1) if array.shape[0] == length else array.T
        single = flat.shape[1] == 1
        names += [name] if single else [f"{name}.{i}" for i in range(flat.shape[1])]
        found += [units.get(label) or unit] * flat.shape[1]
        columns.append(flat)
    if left_out:
        notes = [*notes, f"left out, not being {length} samples long: {', '.join(left_out)}"]
    values, time = np.hstack(columns), None
    if times_function is not None and not any(is_time_name(name) for name in names):
        time = "time"
        names, found = [time, *names], ["s", *found]
        values = np.column_stack([times_function(length), values])
    return LogTable(tuple(names), tuple(found), values, time=time, notes=tuple(notes))


def is_time_name(name: str) -> bool:
    """Tell whether a column is called as columns of times are."""
    return name.lower() in TIME_NAMES


def _length(arrays: Mapping[str, np.ndarray]) -> int:
    """Number of samples: that of the times, or else the one that most arrays have."""
    for label, array in arrays.items():
        if is_time_name(parse_heading(label)[0]):
            return max(array.shape, default=0)
    sizes = [max(array.shape) for array in arrays.values() if array.ndim and array.size > 1]
    return max(sizes, key=lambda size: (sizes.count(size), size), default=0)


def read_bytes(path: Path, count: int = -1) -> bytes:
    """Return the bytes of a file, or the first few.

    Raises ValueError if there is no such file or it is empty.
    """
    if not path.is_file():
        raise ValueError(f"{path}: there is no such log file")
    with open(path, "rb") as file:
        data = file.read(count)
    if not data:
        raise ValueError(f"{path}: the log is empty")
    return data


def read_text(path: Path) -> str:
    """Return the text of a file: UTF-8, or the Windows encoding older loggers write.

    Raises ValueError if there is no such file, it is empty, or it is no text.
    """
    data = read_bytes(path)
    if b"\0" in data:
        raise ValueError(f"{path}: this is no text but a binary file of no kind known here")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")
    if not text.strip():
        raise ValueError(f"{path}: the log is empty")
    return text


def text_attribute(attribute: Any) -> str | None:
    """The text of an attribute of a file, None if it holds none."""
    if isinstance(attribute, bytes):
        attribute = attribute.decode(errors="replace")
    return attribute if isinstance(attribute, str) and attribute else None


def damaged_file_error(path: Path, error: Exception) -> ValueError:
    """The error for a file that the library which reads it stumbles over, in one line."""
    words = "".join(letter if letter.isprintable() else " " for letter in str(error))
    why = textwrap.shorten(words, 150, placeholder=" ...") or type(error).__name__
    return ValueError(f"{path}: the file is damaged or cut off: {why}")


def parse_numbers(
    path: Path,
    names: Sequence[str],
    rows: Sequence[Sequence[str]],
    lines: Sequence[int],
    decimal_comma: bool,
) -> Float[np.ndarray, "row column"]:
    """Convert the cells of a table, given the line number of each row; empty ones become NaN.

    Raises ValueError naming file, line and column for a cell that is no number.
    """
    if not rows:
        raise ValueError(f"{path}: the log is empty: there are column names but no rows")
    for row, line in zip(rows, lines, strict=True):
        if len(row) != len(names):
            raise ValueError(f"{path}, line {line}: {len(row)} cells for {len(names)} columns")
    rows = [[cell if cell.strip() else "nan" for cell in row] for row in rows]
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
                what = f"{cell.strip()!r} is no number"
                return ValueError(f"{path}, line {line}, column {name!r}: {what}")
    raise AssertionError("numpy refused what Python reads as numbers")
