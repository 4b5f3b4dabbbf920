"""Workbooks of Excel (.xlsx), by openpyxl: each sheet with a table of numbers is a run."""

import datetime
import io
from pathlib import Path

from jaxbeam.files.endings import import_extra
from tuning.logs.readers.headings import find_headings, is_numeric, table_of_rows
from tuning.logs.readers.table import LogFormat, LogTable, damaged_file_error, read_bytes

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
        table = _table(f"{path}, sheet {title!r}", rows)
        if table is not None:
            tables[title] = table
    return {"": next(iter(tables.values()))} if len(tables) == 1 else tables


def _table(source: str, rows) -> LogTable | None:
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


FORMAT = LogFormat("Excel", read_xlsx, suffixes=(".xlsx",), magics=(MAGIC,))
