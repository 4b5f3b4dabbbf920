"""Columns of dates and times of day, as loggers write them, in seconds from the first.

2024-05-14T09:30:00.010+02:00    14.05.2024 09:30:00,010    5/14/2024 9:30:00 AM    09:30:00.010
"""

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

from tuning.logs.readers.table import shown

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
