"""Headings above the rows of a table: names and units of columns, other lines that are skipped."""

import re
from collections.abc import Sequence
from typing import NamedTuple

from jaxbeam.files.tables import from_text_cell
from tuning.logs.readers.stamps import is_stamp
from tuning.logs.readers.table import is_time_name, parse_heading
from tuning.logs.units import is_unit

MAX_HEADING_ROWS = 100  # rows at the top among which the first row of numbers is searched
_BRACKETS = re.compile(r"^[\[(](.*)[\])]$")


class Headings(NamedTuple):
    """Names and units of the columns of a table, and the index of its first row of numbers.

    `names` are empty for a table without headings. `notes` say which rows above were skipped.
    """

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    first_row: int
    notes: tuple[str, ...]


def find_headings(rows: Sequence[Sequence[str]]) -> Headings:
    """Headings among the first rows of a table (cells of text).

    Of the rows of words above the first row of numbers, and as wide as that one, the headings are
    the first that names a column of times or a unit in brackets, or else the last. A row of units
    may follow. Other rows of words are skipped.
    """
    first = next(
        (i for i, row in enumerate(rows[:MAX_HEADING_ROWS]) if is_numeric(row)),
        min(len(rows), MAX_HEADING_ROWS),
    )
    width = len(rows[first] if first < len(rows) else rows[0])
    candidates = [i for i in range(first) if _is_heading(rows[i], width)]
    head = next(
        (i for i in candidates if _names_columns(rows[i])),
        next((i for i in reversed(candidates) if not _is_unit_row(rows[i])), None),
    )
    if head is None and first > 0 and any(_is_number(cell) for cell in rows[0] if cell.strip()):
        first = 0  # rows of numbers from the top on, the first ones damaged
    if head is None:
        notes = (f"{first} lines above the numbers are skipped",) if first else ()
        return Headings((), (), first, notes)
    cells = [from_text_cell(cell.strip()) for cell in rows[head]]
    while len(cells) > 1 and not cells[-1]:
        cells.pop()
    names, units = zip(*map(parse_heading, cells), strict=True)
    has_unit_row = head + 1 < first and _is_unit_row(rows[head + 1])
    if has_unit_row:
        below = [_BRACKETS.sub(r"\1", cell.strip()) for cell in rows[head + 1]]
        below += [""] * (len(names) - len(below))
        units = tuple(own or found or None for own, found in zip(units, below, strict=False))
    after = head + 1 + has_unit_row
    if first < len(rows) and not any(
        _is_number(cell) for row in rows[after:first] for cell in row if cell.strip()
    ):
        after = first
    skipped = after - 1 - has_unit_row
    notes = (f"{skipped} lines beside the headings are skipped",) if skipped else ()
    return Headings(names, units, after, notes)


def is_numeric(row: Sequence[str]) -> bool:
    """Whether the cells of a row that are not empty are numbers, at least one, and stamps."""
    cells = [cell for cell in row if cell.strip()]
    numbers = list(map(_is_number, cells))
    return any(numbers) and all(n or is_stamp(c) for n, c in zip(numbers, cells, strict=True))


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _is_heading(row, width: int) -> bool:
    """Whether a row may hold names of so many columns (a separator at the end counts as none)."""
    named = [cell.strip() for cell in row]
    while named and not named[-1]:
        named.pop()
    return (
        bool(named)
        and not any(_is_number(cell) for cell in named if cell)
        and abs(len(named) - width) <= 1
        and (width > 2 or len(named) == width or len(named) > 1)
    )


def _names_columns(row) -> bool:
    """Whether one of the cells is the name of a column of times, or has a unit of the table."""
    headings = [parse_heading(cell) for cell in row]
    return any(is_time_name(name) or (unit and is_unit(unit)) for name, unit in headings)


def _is_unit_row(row) -> bool:
    """Whether the cells of a row that are not empty are units, as `s` or `[mm]`."""
    cells = [_BRACKETS.sub(r"\1", cell.strip()) for cell in row if cell.strip()]
    return bool(cells) and all(map(is_unit, cells))
