"""Separated values (.csv, .tsv, .txt, .dat, .asc): names with units in the headings, numbers below.

    time (s); d1 [mm]; d2 [mm]
    0,000; 0,12; -0,03

Lines that start with `#`, `%` or `//` are comments. Other lines above the headings are skipped; a
line of units may follow the headings. A file without headings is read with columns that the user
names. Dates and times of day become seconds from the first.
"""

import csv
import dataclasses
import io
import re
from pathlib import Path

import numpy as np

from tuning.logs.readers.headings import (
    MAX_HEADING_ROWS,
    Headings,
    find_headings,
    table_of_rows,
    unnamed,
)
from tuning.logs.readers.table import CHECKED_ROWS, LogFormat, LogTable, check_last_line, read_text

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
    return {"": _table(path, lines[first:], numbers[first:], separator, headings, width)}


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


def _table(path, lines, numbers, separator, headings: Headings, width: int) -> LogTable:
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


FORMAT = LogFormat(
    "separated values", read_csv, suffixes=(".csv", ".tsv", ".txt", ".dat", ".asc"), is_text=True
)
