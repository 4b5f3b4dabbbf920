"""Headings above the rows of a table: names and units of columns, other lines that are skipped.

Columns of dates and times of day, as loggers write them, in seconds from the first.

2024-05-14T09:30:00.010+02:00    14.05.2024 09:30:00,010    5/14/2024 9:30:00 AM    09:30:00.010
14-May-2024 09:30:00 CEST        14.05.2024;09:30:00,010    (a column of dates before one of times)
"""

import itertools
import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxbeam.files.tables import from_text_cell
from tuning.logs.readers.table import (
    LogTable,
    check_widths,
    is_time_name,
    number_of,
    parse_heading,
    parse_numbers,
    shown,
)
from tuning.logs.units import is_unit

_CLOCK = (
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2}(?:[.,:]\d+)?))?"
    r"\s*(?P<half>[AaPp]\.?[Mm]\.?)?"
)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_DATE = r"(?P<a>\d{1,4})(?P<mark>[-./ ])(?P<b>\d{1,2}|[A-Za-z]{3,9}\.?)(?P=mark)(?P<c>\d{1,4})"
# Hours from UTC by the names that loggers write, winter and summer.
_ZONES = {"Z": 0, "UTC": 0, "GMT": 0, "WET": 0, "BST": 1, "WEST": 1, "CET": 1, "CEST": 2, "EET": 2,
          "EEST": 3, "EST": -5, "EDT": -4, "CST": -6, "CDT": -5, "MST": -7, "MDT": -6, "PST": -8,
          "PDT": -7}  # fmt: skip
_ZONE = rf"(?P<zone>{'|'.join(_ZONES)}|[-+]\d{{2}}:?\d{{2}})?"
_STAMP = re.compile(rf"{_DATE}[T ]\s*{_CLOCK}\s*{_ZONE}")
_DAY, _TIME_OF_DAY = re.compile(_DATE), re.compile(_CLOCK)
DAY, HOUR = 86400.0, 3600.0  # s
FRIDAY, LATEST_CHANGE = 4, 4  # first day of the week, and last hour, of clocks set forward
LEAST_SECONDS = 4  # number of stamps without fractions from which the samples in one are counted


def is_day(cell: str) -> bool:
    """Whether a cell is a date without a time of day."""
    return _DAY.fullmatch(cell.strip()) is not None


def is_stamp(cell: str) -> bool:
    """Whether a cell is a date with a time of day, or a time of day with seconds."""
    cell = cell.strip()
    found = _TIME_OF_DAY.fullmatch(cell)
    return bool(_STAMP.fullmatch(cell)) or (found is not None and found["second"] is not None)


class Stamps(NamedTuple):
    """Seconds from the first stamp, that stamp (ISO 8601, or the time of day), and notes."""

    seconds: list[float]
    start: str
    said: tuple[str, ...] = ()


def _day_before_time(row: Sequence[str]) -> int | None:
    """Index of a date that is followed by a time of day, in a row; None if there is none."""
    for i, cell in enumerate(row[:-1]):
        day = cell.strip().removesuffix(" 00:00:00")  # as workbooks have dates
        if is_day(day) and _TIME_OF_DAY.fullmatch(row[i + 1].strip()):
            return i
    return None


def seconds_of(path: Path, column: str, cells: Sequence[str], lines: Sequence[int]) -> Stamps:
    """Seconds from the first stamp of a column.

    After midnight times of day go on, and so do local times when the clock is set by an hour.
    Stamps of whole seconds that repeat evenly are samples of so many a second. Where day and month
    are ambiguous, the order is the one in which stamps are nearer to each other.

    Raises ValueError, naming the line, for a cell that is no stamp like the first, and dates whose
    day and month are ambiguous.
    """

    def place(line):
        return f"{path}, line {line}, column {shown(column)}"

    dated = _STAMP.fullmatch(cells[0].strip()) is not None
    pattern = _STAMP if dated else _TIME_OF_DAY
    found = [pattern.fullmatch(cell.strip()) for cell in cells]
    for one, cell, line in zip(found, cells, lines, strict=True):
        if one is None:
            raise ValueError(f"{place(line)}: {shown(cell)} is no date and time")
    said, moments = [], []
    try:
        if dated:
            moments = _moments(found)
            start = moments[0].isoformat()
            if _order(found) is None and moments[0].date() == moments[-1].date():
                start = moments[0].time().isoformat(timespec="milliseconds")
                said.append(
                    f"whether the day or the month comes first in {cells[0].strip()} is ambiguous:"
                    " times are seconds from the first, and their date is left out"
                )
            seconds = np.array([(one - moments[0]).total_seconds() for one in moments])
        else:
            own = np.array([_of_day(one) for one in found])
            day = datetime.min + timedelta(seconds=float(own[0]))
            start = day.time().isoformat(timespec="milliseconds")
            seconds = own - own[0] + DAY * np.cumsum(np.diff(own, prepend=own[0]) < -DAY / 2)
    except (ValueError, TypeError, OverflowError) as error:  # TypeError: with and without zone
        raise ValueError(f"{place(lines[0])}: dates and times: {error}") from None
    if moments and moments[0].tzinfo is None:
        steps = np.diff(seconds)
        usual = float(np.median(steps)) if steps.size else 0.0
        jumps = np.abs(np.abs(steps - usual) - HOUR) < max(usual, 0.5)
        for i in np.flatnonzero(jumps).tolist():
            after = moments[i + 1]
            if usual > HOUR / 10 or after.minute or after.second > max(usual, 0.5):
                continue
            forward = steps[i] > 0
            at_night = moments[i + 1].hour <= LATEST_CHANGE and moments[i + 1].weekday() >= FRIDAY
            if forward and not at_night:  # an hour without samples
                continue
            seconds[i + 1 :] += -HOUR if forward else HOUR
            said.append(
                f"the clock is set {'forward' if forward else 'back'} by an hour in line"
                f" {lines[i + 1]} (daylight saving); times go on"
            )
    counted = _within_seconds(seconds)
    if counted is not None:
        seconds = counted
        said.append(
            "stamps of whole seconds: times are those of"
            f" {1 / (seconds[1] - seconds[0]):.6g} samples a second, counted between them"
        )
    return Stamps(seconds.tolist(), start, tuple(said))


def _within_seconds(seconds: np.ndarray) -> np.ndarray | None:
    """Even times of samples whose stamps are rounded down to seconds; None for other stamps."""
    begins = np.flatnonzero(np.diff(seconds, prepend=-np.inf))
    if begins.size < LEAST_SECONDS or begins.size == seconds.size:
        return None
    counts, resolution = np.diff(begins)[1:], np.diff(seconds[begins])[1:]
    whole = np.all(resolution == resolution[0]) and resolution[0] >= 1.0
    if not whole or np.ptp(counts) > 1 or counts.min() < 2:
        return None
    return np.arange(seconds.size) * float(resolution[0] / counts.mean())


def epoch_seconds(stamp: str) -> float:
    """Seconds from 1970 (of UTC without a zone) of a date and time, 0 for a time of day alone."""
    found = _STAMP.fullmatch(stamp.strip())
    if found is None:
        return 0.0
    moment = _moments([found])[0]
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _moments(found: Sequence[re.Match]) -> list[datetime]:
    """Dates and times of stamps.

    Raises ValueError if day and month are ambiguous.
    """
    order = _order(found)
    if order is None and len({(one["a"], one["b"]) for one in found}) == 1:
        order = "dmy"  # one day, whichever
    if order is not None:
        return [_moment(one, order) for one in found]
    tried = [[_moment(one, order) for one in found] for order in ("dmy", "mdy")]
    even = [moments for moments in tried if _is_even(moments)]
    if len(even) != 1:
        raise ValueError(
            "whether the day or the month comes first is ambiguous; write 2024-05-14 09:30:00"
        )
    return even[0]


def _is_even(moments: Sequence[datetime]) -> bool:
    """Whether three or more times ascend in steps that differ by less than half a day."""
    steps = [(b - a).total_seconds() for a, b in itertools.pairwise(moments)]
    return len(steps) > 1 and min(steps) >= 0 and max(steps) < min(steps) + DAY / 2


def _order(found: Sequence[re.Match]) -> str | None:
    """Order of year, month and day in dates; None if it is ambiguous."""
    if len(found[0]["a"]) == 4:
        return "ymd"
    if found[0]["mark"] == "." or any(_number(one["a"]) > 12 for one in found):
        return "dmy"
    if not found[0]["b"].isdecimal():
        return "dmy"
    if any(_number(one["b"]) > 12 for one in found):
        return "mdy"
    return "dmy" if found[0]["a"] == found[0]["b"] else None


def _number(part: str) -> int:
    """Number of a day, month or year; ValueError for a word that is not the name of a month."""
    return int(part) if part.isdecimal() else _MONTHS.index(part[:3].lower()) + 1


def _moment(found: re.Match, order: str) -> datetime:
    numbers = dict(zip(order, (_number(found[name]) for name in "abc"), strict=True))
    year = numbers["y"] + (2000 if numbers["y"] < 100 else 0)
    day = datetime(year, numbers["m"], numbers["d"], tzinfo=_zone(found["zone"]))
    return day + timedelta(seconds=_of_day(found))


def _of_day(found: re.Match) -> float:
    hour, minute = int(found["hour"]), int(found["minute"])
    if found["half"]:
        hour = hour % 12 + (12 if found["half"].lower().startswith("p") else 0)
    if hour > 24 or minute > 59:
        raise ValueError(f"there is no time {hour}:{minute:02}")
    return 3600.0 * hour + 60.0 * minute + float(re.sub("[,:]", ".", found["second"] or "0"))


def _zone(text: str | None) -> timezone | None:
    if text is None:
        return None
    if text in _ZONES:
        return timezone(timedelta(hours=_ZONES[text]))
    minutes = 60 * int(text[1:3]) + int(text[-2:])
    return timezone(timedelta(minutes=-minutes if text[0] == "-" else minutes))


_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")
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
    if head is None and first > 0 and any(map(_is_number, rows[0])):
        first = 0  # rows of numbers from the top on, the first ones damaged
    if head is None:
        notes = (f"{first} lines above the numbers are skipped",) if first else ()
        return Headings((), (), first, notes)
    cells = [from_text_cell(cell.strip()) for cell in rows[head]]
    if head + 1 < first and "" in cells[1:width]:
        merged = _with_names_below(cells[:width], rows[head + 1])
        head, cells = (head, cells) if merged is None else (head + 1, merged)
    while len(cells) > 1 and not cells[-1]:
        cells.pop()
    names, units = zip(*map(parse_heading, cells), strict=True)
    has_unit_row = head + 1 < first and _is_unit_row(rows[head + 1])
    if has_unit_row:
        below = [_BRACKETS.sub(r"\1", cell.strip()) for cell in rows[head + 1]]
        below += [""] * (len(names) - len(below))
        units = tuple(own or found or None for own, found in zip(units, below, strict=False))
    after = head + 1 + has_unit_row
    if first < len(rows) and not any(_is_number(cell) for row in rows[after:first] for cell in row):
        after = first
    skipped = after - 1 - has_unit_row
    notes = (f"{skipped} lines other than the headings are skipped",) if skipped else ()
    return Headings(names, units, after, notes)


def _with_names_below(cells: Sequence[str], below: Sequence[str]) -> list[str] | None:
    """Headings of which some are merged over several columns, named in the row below; else None.

    Time [s] | Acceleration [g] |    | Strain [um/m]
             | a1               | a2 | s1                gives   Time [s], a1 [g], a2 [g], s1 [um/m]
    """
    named = [from_text_cell(cell.strip()) for cell in below]
    named += [""] * (len(cells) - len(named))
    both = list(zip(cells, named, strict=False))
    if _is_unit_row(below) or any(not own and not name for own, name in both):
        return None
    found, unit = [], None
    for own, name in both:
        unit = parse_heading(own)[1] if own else unit
        has_own = not name or parse_heading(name)[1]
        found.append((name or own) if has_own or not unit else f"{name} [{unit}]")
    return found


def is_numeric(row: Sequence[str]) -> bool:
    """Whether the cells of a row that are not empty are numbers, at least one, and stamps."""
    cells = [cell for cell in row if cell.strip()]
    return any(map(_is_number, cells)) and all(
        number_of(cell) is not None or is_stamp(cell) or is_day(cell) for cell in cells
    )


def _is_number(cell: str) -> bool:
    """Whether a cell is a number or nan; not so words for a missing sample."""
    found = number_of(cell)
    return found is not None and (not np.isnan(found) or "nan" in cell.lower())


def _is_heading(row, width: int) -> bool:
    """Whether a row may hold names of so many columns (a separator at the end counts as none)."""
    named = [cell.strip() for cell in row]
    while named and not named[-1]:
        named.pop()
    return (
        bool(named)
        and not any(map(_is_number, named))
        and abs(len(named) - width) <= 1
        and (width > 2 or len(named) == width or len(named) > 1)
    )


def _names_columns(row) -> bool:
    """Whether one of the cells is the name of a column of times, or has a unit of the table."""
    headings = [parse_heading(cell) for cell in row]
    return any(is_time_name(name, unit) or (unit and is_unit(unit)) for name, unit in headings)


def _is_unit_row(row) -> bool:
    """Whether the cells of a row that are not empty are units, as `s` or `[mm]`."""
    cells = [_BRACKETS.sub(r"\1", cell.strip()) for cell in row if cell.strip()]
    return bool(cells) and all(map(is_unit, cells))


def unnamed(count: int) -> tuple[str, ...]:
    """Names of columns that have none in the file."""
    return tuple(f"column {i + 1}" for i in range(count))


def table_of_rows(
    source: Path,
    headings: Headings,
    rows: Sequence[Sequence[str]],
    lines: Sequence[int],
    may_have_commas: bool,
) -> LogTable:
    """Table of rows of cells below their headings, with line numbers; stamps become seconds.

    Raises ValueError, naming the line, for a row of another length, a cell that is no number nor
    stamp, and numbers with both decimal commas (if there may be any) and decimal points.
    """
    names = list(headings.names or unnamed(len(rows[0]) if rows else 0))
    units = list(headings.units or (None,) * len(names))
    stamped, began, said = [], "", ()
    others = rows
    if rows and any(is_stamp(cell) for cell in rows[0]):
        check_widths(source, names, rows, lines)
        rows, day = [list(row) for row in rows], _day_before_time(rows[0])
        if day is not None:
            del names[day], units[day]
            rows = [
                [*row[:day], f"{row[day].split()[0]} {row[day + 1].strip()}", *row[day + 2 :]]
                for row in rows
            ]
        stamped = [i for i, cell in enumerate(rows[0]) if is_stamp(cell)]
        others = [[cell for i, cell in enumerate(row) if i not in stamped] for row in rows]
    for i in stamped:
        found = seconds_of(source, names[i], [row[i] for row in rows], lines)
        began, said, units[i] = began or found.start, (*said, *found.said), "s"
        for row, second in zip(rows, found.seconds, strict=True):
            row[i] = repr(second)
    has_commas = _has_decimal_comma(source, others, lines, may_have_commas)
    values = parse_numbers(source, names, rows, lines, has_commas)
    return LogTable(
        tuple(names), tuple(units), values, np.array(lines), notes=headings.notes,
        time=names[stamped[0]] if stamped else None, has_headings=bool(headings.names),
        warnings=said, start=began,
    )  # fmt: skip


def _has_decimal_comma(source, rows, lines, are_usual: bool) -> bool:
    """Whether cells have decimal commas, which `are_usual` unless the comma separates columns.

    Raises ValueError for a file with points as well, and for commas that are not usual and may
    all separate thousands.
    """
    commas = [(i, cell) for i, row in enumerate(rows) for cell in row if "," in cell]
    point = next((i for i, row in enumerate(rows) if any("." in cell for cell in row)), None)
    if not commas:
        return False
    first, cell = commas[0]
    if are_usual and point is not None:
        raise ValueError(
            f"{source}, lines {lines[first]} and {lines[point]}: numbers have both decimal commas "
            "and decimal points; write one of them throughout, without thousands separators"
        )
    if not are_usual and all(_THOUSANDS.fullmatch(cell.strip()) for _, cell in commas):
        raise ValueError(
            f"{source}, line {lines[first]}: the comma in {shown(cell)} is a decimal one or "
            "separates thousands; write numbers with decimal points, without thousands separators"
        )
    return True
