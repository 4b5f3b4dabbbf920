"""Separated values (.csv, .tsv, .txt, .dat): names with units in the first line, numbers below.

    time (s); d1 [mm]; d2 [mm]
    0,000; 0,12; -0,03

Lines at the top that start with `#` are comments.
"""

import csv
import io
from pathlib import Path

import numpy as np

from tuning.logs.readers.table import LogFormat, LogTable, parse_heading, parse_numbers, read_text


def read_csv(path: Path) -> dict[str, LogTable]:
    """Table of a file of values separated by tabs, semicolons or commas.

    The separator is the first of these three that occurs in the line of names. Unless it is the
    comma, numbers may have a decimal comma. Units stand in brackets or parentheses after names.

    Raises ValueError, naming file and line, for a missing line of names, a row of another length
    and a cell that is no number.
    """
    text = read_text(path)
    header_index = 0
    text_lines = text.splitlines(keepends=True)
    while header_index < len(text_lines) and (
        not text_lines[header_index].strip() or text_lines[header_index].startswith("#")
    ):
        header_index += 1
    if header_index == len(text_lines):
        raise ValueError(f"{path}: the log is empty: it has comments only")
    separator = next((mark for mark in "\t;" if mark in text_lines[header_index]), ",")
    rows, lines = _nonempty_rows(path, text_lines, header_index, separator)
    if not rows:
        raise ValueError(f"{path}: the log is empty: no cell has anything in it")
    headings = [cell.strip() for cell in rows[0]]
    if _all_numbers(headings):
        raise ValueError(
            f"{path}, line {header_index + 1}: the first line must name the columns, "
            f"e.g. time [s]{separator}d1 [mm]"
        )
    if not headings[-1]:
        headings.pop()
    # A separator that ends every line closes the last column; it opens no new one.
    trailing = len(headings) + 1
    rows = [row[:-1] if len(row) == trailing and not row[-1].strip() else row for row in rows[1:]]
    lines = lines[1:]
    names, units = zip(*map(parse_heading, headings), strict=True)
    decimal_comma = separator != "," and _has_decimal_comma(path, rows, lines)
    values = parse_numbers(path, names, rows, lines, decimal_comma)
    return {"": LogTable(names, units, values, np.array(lines))}


def _nonempty_rows(path, kept, top, separator):
    """Cells of the rows that are not empty, from the line of names on, and their line numbers."""
    reader = csv.reader(io.StringIO("".join(kept[top:])), delimiter=separator)
    rows, lines = [], []
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                rows.append(row)
                lines.append(top + reader.line_num)
    except csv.Error as error:
        raise ValueError(f"{path}, line {top + reader.line_num}: {error}") from None
    return rows, lines


def _all_numbers(cells) -> bool:
    try:
        [float(cell.replace(",", ".")) for cell in cells]
    except ValueError:
        return False
    return True


def _has_decimal_comma(path, rows, lines) -> bool:
    """Whether cells have decimal commas. Raises ValueError for a file with points as well."""
    comma = next((i for i, row in enumerate(rows) if any("," in cell for cell in row)), None)
    point = next((i for i, row in enumerate(rows) if any("." in cell for cell in row)), None)
    if comma is not None and point is not None:
        raise ValueError(
            f"{path}, lines {lines[comma]} and {lines[point]}: numbers have both decimal commas "
            "and decimal points; write one of them throughout, without thousands separators"
        )
    return comma is not None


FORMAT = LogFormat(
    "separated values", read_csv, suffixes=(".csv", ".tsv", ".txt", ".dat"), is_text=True
)
