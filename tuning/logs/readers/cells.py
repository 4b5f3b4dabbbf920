"""Rows of cells below headings: separated values (.csv, .tsv, .txt, .dat, .asc), Excel (.xlsx).

    time (s); d1 [mm]; d2 [mm]
    0,000; 0,12; -0,03

Lines that start with `#`, `%` or `//` are comments. Other lines above the headings are skipped; a
line of units may follow the headings. A file without headings is read with columns that the user
names. Dates and times of day become seconds from the first.
"""

import csv
import dataclasses
import datetime
import io
import re
from pathlib import Path

import numpy as np

from jaxbeam.runtime.packages import import_extra
from tuning.logs.readers.headings import (
    MAX_HEADING_ROWS,
    Headings,
    find_headings,
    is_numeric,
    table_of_rows,
    unnamed,
)
from tuning.logs.readers.table import (
    CHECKED_ROWS,
    LogFormat,
    LogTable,
    check_last_line,
    damaged_file_error,
    read_bytes,
    read_text,
)

RECORD_NUMBER = "RN"  # the unit that Campbell loggers give it
_COMMENTS = ("#", "%", "//")
_SPACED_DECIMAL_COMMAS = re.compile(r"^\s*[-+]?\d+,\d+([eE][-+]?\d+)?\s+[-+]?\d+(,\d+)?")
_SPACED_NUMBERS = re.compile(r"^\s*[-+]?[\d.]+([eE][-+]?\d+)?\s+[-+]?[\d.]+[\s\d.eE+-]*$")


def read_csv(path: Path) -> dict[str, LogTable]:
    """Table of a file of values separated by tabs, semicolons, commas or spaces.

    The separator is that of most lines. Unless it is the comma, numbers may have a decimal comma.
    Units stand in brackets or parentheses after names, or in the line below.

    Raises ValueError, naming file and line, for a row of another length, a cell that is no number,
    numbers with both decimal commas and decimal points, and for a file without numbers.
    """
    text = read_text(path)
    numbered = [
        (number, line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip("\ufeff\t;, ") and not line.lstrip("\ufeff \t\"'").startswith(_COMMENTS)
    ]
    if not numbered:
        raise ValueError(f"{path}: the log is empty: it has comments only, or no cell with text")
    numbers, lines = zip(*numbered, strict=True)
    separator = _separator(lines)
    top, _ = _rows(path, lines[: 2 * MAX_HEADING_ROWS], numbers, separator)
    headings = _campbell_headings(top) or find_headings(top)
    first = headings.first_row
    if not headings.names and first >= len(top):
        raise ValueError(f"{path}: the log is empty: it has no row of numbers")
    width = len(headings.names) or len(top[first])
    tail, tail_lines = _rows(
        path, lines[first:][-CHECKED_ROWS:], numbers[first:][-CHECKED_ROWS:], separator
    )
    check_last_line(path, text, tail, tail_lines)
    return {"": _table_of_lines(path, lines[first:], numbers[first:], separator, headings, width)}


def _campbell_headings(rows) -> Headings | None:
    """Headings of a file of Campbell loggers (TOA5): station, names, units, processing."""
    if len(rows) < 5 or rows[0][0] != "TOA5":
        return None
    units = tuple(cell.strip() if cell.strip() != "TS" else None for cell in rows[2])
    return Headings(tuple(cell.strip() for cell in rows[1]), units, 4, ())


def _separator(lines) -> str:
    """Separator of most lines: tab, semicolon, spaces or comma, in this order."""
    sample = lines[-200:]
    for mark in "\t;":
        if 2 * sum(mark in line for line in sample) >= len(sample):
            return mark
    for pattern in (_SPACED_DECIMAL_COMMAS, _SPACED_NUMBERS):
        if 2 * sum(bool(pattern.match(line)) for line in sample) >= len(sample):
            return " "
    return ","


def _rows(path, lines, numbers, separator):
    """Cells of lines, and the number of the last line of each row."""
    if separator == " ":
        return [line.split() for line in lines], list(numbers)
    reader = csv.reader(list(lines), delimiter=separator)
    rows, last = [], []
    try:
        for row in reader:
            rows.append(row)
            last.append(numbers[reader.line_num - 1])
    except csv.Error as error:
        raise ValueError(f"{path}, line {numbers[reader.line_num - 1]}: {error}") from None
    return rows, last


def _table_of_lines(path, lines, numbers, separator, headings: Headings, width: int) -> LogTable:
    """Table of the lines below the headings."""
    values = _fast_numbers(lines, separator, width)
    if values is None:
        rows, numbers = _rows(path, lines, numbers, separator)
        # A separator that ends every line closes the last column; it opens no new one.
        if not headings.names and rows and all(not row[-1].strip() for row in rows):
            width -= 1
        trailing = width + 1
        rows = [row[:-1] if len(row) == trailing and not row[-1].strip() else row for row in rows]
        table = table_of_rows(path, headings, rows, numbers, separator != ",")
    else:
        names = headings.names or unnamed(width)
        units = headings.units or (None,) * width
        table = LogTable(
            names, units, values, np.array(numbers), notes=headings.notes,
            has_headings=bool(headings.names),
        )  # fmt: skip
    # Campbell loggers count their records.
    kept = [i for i, unit in enumerate(table.units) if unit != RECORD_NUMBER]
    names, units = (tuple(all_[i] for i in kept) for all_ in (table.names, table.units))
    return dataclasses.replace(table, names=names, units=units, values=table.values[:, kept])


def _fast_numbers(lines, separator, width):
    """Values by the parser of NumPy; None for lines that need a closer look."""
    text = "\n".join(lines)
    if separator != "," and "," in text:
        if "." in text:
            return None
        text = text.replace(",", ".")
    if not lines or '"' in text:
        return None
    delimiter = None if separator == " " else separator
    try:
        values = np.loadtxt(io.StringIO(text), delimiter=delimiter, comments=None, ndmin=2)
    except ValueError:
        return None
    return values if values.shape == (len(lines), width) else None


SEPARATED_VALUES = LogFormat(
    "separated values", read_csv, suffixes=(".csv", ".tsv", ".txt", ".dat", ".asc"), is_text=True
)


MAGIC = b"PK\x03\x04"


def read_xlsx(path: Path) -> dict[str, LogTable]:
    """Tables of a workbook: one run for each sheet with numbers, by the name of the sheet.

    Headings are those of separated values. Dates and times of day become seconds from
    the first. Formulas have the values with which the file was saved.

    Raises ValueError, naming sheet and row, for a damaged file and for cells that are no numbers,
    ImportError without openpyxl.
    """
    openpyxl = import_extra("openpyxl", "tables")
    content = io.BytesIO(read_bytes(path))  # openpyxl would leave a damaged file open
    try:
        book = openpyxl.load_workbook(content, read_only=True, data_only=True)
        sheets = {sheet.title: list(sheet.iter_rows(values_only=True)) for sheet in book}
    except Exception as error:  # openpyxl raises many types for damaged files
        raise damaged_file_error(path, error) from None
    tables = {}
    for title, rows in sheets.items():
        table = _table_of_sheet(f"{path}, sheet {title!r}", rows)
        if table is not None:
            tables[title] = table
    return {"": next(iter(tables.values()))} if len(tables) == 1 else tables


def _table_of_sheet(source: str, rows) -> LogTable | None:
    """Table of a sheet; None for one without numbers."""
    numbered = [
        (number, list(map(_text, row)))
        for number, row in enumerate(rows, 1)
        if any(cell is not None for cell in row)
    ]
    used = [i for i in range(max((len(r) for _, r in numbered), default=0))
            if any(i < len(row) and row[i].strip() for _, row in numbered)]  # fmt: skip
    cells = [[row[i] if i < len(row) else "" for i in used] for _, row in numbered]
    if not any(map(is_numeric, cells)):
        return None
    found = find_headings(cells)
    lines = [number for number, _ in numbered[found.first_row :]]
    return table_of_rows(Path(source), found, cells[found.first_row :], lines, False)


def _text(cell) -> str:
    """Text of a cell; dates and times of day as in ISO 8601, durations in seconds."""
    if cell is None:
        return ""
    if isinstance(cell, datetime.datetime):
        return cell.isoformat(sep=" ")
    if isinstance(cell, datetime.timedelta):
        return repr(cell.total_seconds())
    if isinstance(cell, datetime.date | datetime.time):
        return cell.isoformat()
    return cell.replace("_x000D_", "\r") if isinstance(cell, str) else repr(float(cell))


EXCEL = LogFormat("Excel", read_xlsx, suffixes=(".xlsx",), magics=(MAGIC,))
