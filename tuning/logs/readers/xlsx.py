"""Workbooks of Excel (.xlsx), by openpyxl: each sheet with a table of numbers is a run."""

import datetime
from pathlib import Path

import numpy as np

from tuning.logs.readers.headings import find_headings, is_numeric
from tuning.logs.readers.table import LogFormat, LogTable, damaged_file_error, parse_numbers
from tuning.optional import import_extra

MAGIC = b"PK\x03\x04"


def read_xlsx(path: Path) -> dict[str, LogTable]:
    """Tables of a workbook: one run for each sheet with numbers, by the name of the sheet.

    Headings are those of separated values. Dates become seconds since the first. Formulas have the
    values with which the file was saved.

    Raises ValueError, naming sheet and row, for a damaged file and for cells that are no numbers,
    ImportError without openpyxl.
    """
    openpyxl = import_extra("openpyxl", "tables")
    try:
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        sheets = {sheet.title: list(sheet.iter_rows(values_only=True)) for sheet in book}
        book.close()
    except Exception as error:  # openpyxl raises many types for damaged files
        raise damaged_file_error(path, error) from None
    tables = {}
    for title, rows in sheets.items():
        table = _table(f"{path}, sheet {title!r}", rows)
        if table is not None:
            tables[title] = table
    return {"": next(iter(tables.values()))} if len(tables) == 1 else tables


def _table(source: str, rows) -> LogTable | None:
    """Table of a sheet; None for one without numbers."""
    origin = next((cell for row in rows for cell in row if _is_date(cell)), None)
    numbered = [
        (number, [_text(cell, origin) for cell in row])
        for number, row in enumerate(rows, 1)
        if any(cell is not None for cell in row)
    ]
    used = [i for i in range(max((len(r) for _, r in numbered), default=0))
            if any(i < len(row) and row[i].strip() for _, row in numbered)]  # fmt: skip
    cells = [[row[i] if i < len(row) else "" for i in used] for _, row in numbered]
    if not any(map(is_numeric, cells)):
        return None
    found = find_headings(cells)
    names = found.names or tuple(f"column {i + 1}" for i in range(len(used)))
    lines = [number for number, _ in numbered[found.first_row :]]
    values = parse_numbers(Path(source), names, cells[found.first_row :], lines, False)
    units = found.units or (None,) * len(names)
    return LogTable(
        names, units, values, np.array(lines), notes=found.notes, has_headings=bool(found.names)
    )


def _is_date(cell) -> bool:
    return isinstance(cell, datetime.datetime)


def _text(cell, origin) -> str:
    """Text of a cell; seconds since the first date for dates."""
    if cell is None:
        return ""
    if _is_date(cell):
        return repr((cell - origin).total_seconds())
    if isinstance(cell, datetime.timedelta):
        return repr(cell.total_seconds())
    if isinstance(cell, datetime.time):
        return repr(3600 * cell.hour + 60 * cell.minute + cell.second + 1e-6 * cell.microsecond)
    if isinstance(cell, datetime.date):
        return cell.isoformat()
    return cell.replace("_x000D_", "\r") if isinstance(cell, str) else repr(float(cell))


FORMAT = LogFormat("Excel", read_xlsx, suffixes=(".xlsx",), magics=(MAGIC,))
