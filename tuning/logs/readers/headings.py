"""Headings above the rows of a table: names and units of columns, other lines that are skipped.

Columns of dates and times of day, as loggers write them, in seconds from the first.

2024-05-14T09:30:00.010+02:00    14.05.2024 09:30:00,010    5/14/2024 9:30:00 AM    09:30:00.010
"""

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import NamedTuple

from jaxbeam.files.tables import from_text_cell
from tuning.logs.readers.table import is_time_name, parse_heading, shown
from tuning.logs.units import is_unit

_CLOCK = (
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2}(?:[.,]\d+)?))?"
    r"\s*(?P<half>[AaPp][Mm])?"
)
_STAMP = re.compile(
    r"(?P<a>\d{1,4})(?P<mark>[-./])(?P<b>\d{1,2})(?P=mark)(?P<c>\d{1,4})[T ]\s*"
    rf"{_CLOCK}\s*(?P<zone>Z|UTC|[-+]\d{{2}}:?\d{{2}})?"
)
_TIME_OF_DAY = re.compile(_CLOCK)
DAY = 86400.0  # s


def is_stamp(cell: str) -> bool:
    """Whether a cell is a date with a time of day, or a time of day with seconds."""
    cell = cell.strip()
    found = _TIME_OF_DAY.fullmatch(cell)
    return bool(_STAMP.fullmatch(cell)) or (found is not None and found["second"] is not None)


def seconds_of(
    path: Path, column: str, cells: Sequence[str], lines: Sequence[int]
) -> tuple[list[float], str]:
    """Seconds from the first stamp, and that stamp (ISO 8601, or the time of day).

    After midnight times of day go on. Raises ValueError, naming the line, for a cell that is no
    stamp like the first, and dates whose day and month cannot be told apart.
    """

    def place(line):
        return f"{path}, line {line}, column {shown(column)}"

    dated = _STAMP.fullmatch(cells[0].strip()) is not None
    pattern = _STAMP if dated else _TIME_OF_DAY
    found = [pattern.fullmatch(cell.strip()) for cell in cells]
    for one, cell, line in zip(found, cells, lines, strict=True):
        if one is None:
            raise ValueError(f"{place(line)}: {shown(cell)} is no date and time")
    try:
        order = _order(found) if dated else ""
        if dated:
            moments = [_moment(one, order) for one in found]
            return [(one - moments[0]).total_seconds() for one in moments], moments[0].isoformat()
        seconds = [_of_day(one) for one in found]
    except (ValueError, TypeError, OverflowError) as error:  # TypeError: with and without zone
        raise ValueError(f"{place(lines[0])}: dates and times: {error}") from None
    days, relative = 0.0, []
    for before, now in zip([seconds[0], *seconds], seconds, strict=False):
        days += DAY if now < before - DAY / 2 else 0.0
        relative.append(days + now - seconds[0])
    return relative, cells[0].strip()


def epoch_seconds(stamp: str) -> float:
    """Seconds from 1970 (of UTC without a zone) of a date and time, 0 for a time of day alone."""
    found = _STAMP.fullmatch(stamp.strip())
    if found is None:
        return 0.0
    moment = _moment(found, _order([found]))
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _order(found) -> str:
    """Order of year, month and day in dates."""
    if len(found[0]["a"]) == 4:
        return "ymd"
    if found[0]["mark"] == "." or any(int(one["a"]) > 12 for one in found):
        return "dmy"
    if any(int(one["b"]) > 12 for one in found):
        return "mdy"
    if len({(one["a"], one["b"]) for one in found}) > 1:
        raise ValueError(
            "whether the day or the month comes first cannot be told; write 2024-05-14 09:30:00"
        )
    return "dmy"


def _moment(found: re.Match, order: str) -> datetime:
    numbers = dict(zip(order, (int(found[name]) for name in "abc"), strict=True))
    year = numbers["y"] + (2000 if numbers["y"] < 100 else 0)
    day = datetime(year, numbers["m"], numbers["d"], tzinfo=_zone(found["zone"]))
    return day + timedelta(seconds=_of_day(found))


def _of_day(found: re.Match) -> float:
    hour, minute = int(found["hour"]), int(found["minute"])
    if found["half"]:
        hour = hour % 12 + (12 if found["half"].lower() == "pm" else 0)
    if hour > 24 or minute > 59:
        raise ValueError(f"there is no time {hour}:{minute:02}")
    return 3600.0 * hour + 60.0 * minute + float((found["second"] or "0").replace(",", "."))


def _zone(text: str | None) -> timezone | None:
    if text is None:
        return None
    if text in ("Z", "UTC"):
        return UTC
    minutes = 60 * int(text[1:3]) + int(text[-2:])
    return timezone(timedelta(minutes=-minutes if text[0] == "-" else minutes))


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
