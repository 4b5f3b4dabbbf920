"""LabVIEW measurement files (.lvm): a file header, then segments of header, names and rows.

The format is described by National Instruments, "Specification for the LabVIEW Measurement File
(.lvm)". Rows have one column of times, one for each channel, or none; the printed Delta_X is
often rounded, so it is used only where a file has no times.
"""

from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from tuning.logs.readers.table import LogFormat, LogTable, check_last_line, parse_numbers, read_text

MAGIC = "LabVIEW Measurement"
_END = "***End_of_Header***"
_SPECIAL = ("***Start_Special***", "***End_Special***")


@dataclass
class _Segment:
    """One segment: its header, column headings, rows and their line numbers."""

    header: dict[str, list[str]]
    headings: list[str] = field(default_factory=list)
    rows: list[list[str]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)


def read_lvm(path: Path) -> dict[str, LogTable]:
    """Table of a LabVIEW measurement file, with its segments joined in time.

    A segment whose times start again at zero is moved by the difference of the start times.

    Raises ValueError, naming file and line, for headers without end, segments with different
    channels, channels with times of their own, and cells that are no numbers.
    """
    text = read_text(path)
    lines = text.splitlines()
    if not lines[0].startswith(MAGIC):
        raise ValueError(f"{path}, line 1: a LabVIEW measurement file starts with {MAGIC!r}")
    file_header, first = _file_header(path, lines)
    segments = _segments(path, lines, first, _separator(lines), file_header)
    check_last_line(path, text, segments[-1].rows, segments[-1].lines)
    comma = file_header.get("Decimal_Separator", ["."])[0] == ","
    parts = [_columns(path, segment, comma) for segment in segments]
    names, units = parts[0][:2]
    for segment, (other, _, _) in zip(segments, [part[:3] for part in parts], strict=True):
        if other != names:
            raise ValueError(
                f"{path}, line {segment.lines[0]}: this segment has the channels "
                f"{', '.join(other)}, the first one {', '.join(names)}"
            )
    values = _join_segments(path, segments, [part[2] for part in parts])
    numbered = np.concatenate([segment.lines for segment in segments])
    broken, began = _breaks_off(segments[-1]), _start(segments[0])
    start = "" if began is None else (began[0] + timedelta(seconds=began[1])).isoformat()
    table = LogTable(
        ("time", *names), ("s", *units), values, numbered, "time", warnings=broken, start=start
    )
    return {"": table}


def _breaks_off(segment: _Segment) -> tuple[str, ...]:
    """Warning about a segment with fewer rows than its header says."""
    counts = [int(cell) for cell in segment.header.get("Samples", []) if cell.isdigit()]
    if not counts or len(segment.rows) >= max(counts):
        return ()
    return (
        f"the recording breaks off after line {segment.lines[-1]}: the last segment has"
        f" {len(segment.rows)} of {max(counts)} samples",
    )


def _separator(lines) -> str:
    """Separator named in the header, a tab by default."""
    named = next((line for line in lines if line.startswith("Separator")), "Separator\tTab")
    return "," if "Comma" in named else "\t"


def _file_header(path, lines):
    """File header, and the index of the line after it."""
    separator = _separator(lines)
    header = {}
    for i, line in enumerate(lines):
        if line.startswith(_END):
            return header, i + 1
        # With a decimal comma the file is separated by tabs, so this splits no number.
        key, *cells = line.split(separator)
        header[key.strip()] = [cell.strip() for cell in cells] or [""]
    raise ValueError(f"{path}: the header has no end, {_END}")


def _segments(path, lines, first, separator, file_header) -> list[_Segment]:
    """Segments in the lines after the file header."""
    segments: list[_Segment] = []
    header: dict[str, list[str]] | None = None
    special = False
    for number, line in enumerate(lines[first:], first + 1):
        cells = [cell.strip() for cell in line.split(separator)]
        if cells[0] in _SPECIAL:
            special = cells[0] == _SPECIAL[0]
        elif special or not any(cells):
            continue
        elif cells[0] == "Channels":
            header = {**file_header, "Channels": cells[1:]}
        elif header is not None:
            if cells[0] == _END:
                segments.append(_Segment(header))
                header = None
            else:
                header[cells[0]] = cells[1:] or [""]
        elif not segments:
            segments.append(_Segment(file_header, headings=cells))
        elif not segments[-1].headings:
            segments[-1].headings = cells
        else:
            segments[-1].rows.append(cells)
            segments[-1].lines.append(number)
    segments = [segment for segment in segments if segment.rows]
    if not segments:
        raise ValueError(f"{path}: the log is empty: there is no row after the header")
    return segments


def _columns(path, segment: _Segment, decimal_comma: bool):
    """Names, units and values of a segment; the first column of values is the time (s)."""
    headings = segment.headings
    if "Comment" in headings:
        headings = headings[: headings.index("Comment")]
    while headings and not headings[-1]:
        headings = headings[:-1]
    time_columns = [i for i, heading in enumerate(headings) if heading == "X_Value"]
    channels = [i for i, heading in enumerate(headings) if heading != "X_Value"]
    without_times = segment.header.get("X_Columns", ["One"])[0] == "No"
    used = channels if without_times else time_columns + channels
    if not channels or not (without_times or time_columns):
        raise ValueError(
            f"{path}, line {segment.lines[0] - 1}: the column headings must be X_Value and the "
            f"channels, not {', '.join(segment.headings)}"
        )
    rows = [[row[i] if i < len(row) else "" for i in used] for row in segment.rows]
    names = tuple(headings[i] for i in channels)
    values = parse_numbers(path, [headings[i] for i in used], rows, segment.lines, decimal_comma)
    _check_starts(path, segment, names, decimal_comma)
    times = values[:, : len(used) - len(channels)]
    if without_times:
        times = _implicit_times(path, segment, decimal_comma)
    elif np.any(times != times[:, :1]):
        row = int(np.argmax(np.any(times != times[:, :1], axis=1)))
        raise ValueError(
            f"{path}, line {segment.lines[row]}: the channels have different times; "
            "resample them to common times, or save them to separate files"
        )
    labels = segment.header.get("Y_Unit_Label", [])
    units = tuple((labels[i] if i < len(labels) else "") or None for i in range(len(channels)))
    return names, units, np.hstack([times[:, :1], values[:, -len(channels) :]])


def _check_starts(path, segment: _Segment, names, decimal_comma: bool) -> None:
    """Raise ValueError for channels that start at different times, by the header of a segment."""
    for key in ("X0", "Date", "Time", "Delta_X"):
        cells = [cell for cell in segment.header.get(key, [])[: len(names)] if cell]
        if decimal_comma and key in ("X0", "Delta_X"):
            cells = [cell.replace(",", ".") for cell in cells]
        differ = next((i for i, cell in enumerate(cells) if not _alike(cell, cells[0])), None)
        if differ is not None:
            raise ValueError(
                f"{path}, line {segment.lines[0]}: the channels {names[0]} and {names[differ]} have"
                f" different times: {key} is {cells[0]} and {cells[differ]}; save them to separate"
                " files"
            )


def _alike(cell: str, other: str) -> bool:
    try:
        return abs(float(cell) - float(other)) <= 1e-6 * abs(float(other))
    except ValueError:
        return cell == other


def _implicit_times(path, segment: _Segment, decimal_comma: bool):
    """Times (s) of a segment without a column of times, from X0 and Delta_X."""
    if not segment.header.get("Delta_X", [""])[0]:
        raise ValueError(f"{path}: the log has neither a column of times (X_Value) nor a Delta_X")
    cells = [segment.header.get("X0", [""])[0] or "0", segment.header["Delta_X"][0]]
    line = segment.lines[0]
    start, step = parse_numbers(path, ["X0", "Delta_X"], [cells], [line], decimal_comma)[0]
    return (start + step * np.arange(len(segment.rows)))[:, None]


def _join_segments(path, segments, values):
    """Values of all segments; one whose times start again is moved by its start time."""
    joined = [values[0]]
    for before, segment, rows in zip(segments, segments[1:], values[1:], strict=False):
        if rows[0, 0] <= joined[-1][-1, 0]:
            moved = joined[0][0, 0] + _seconds_between(path, segments[0], segment)
            rows = np.column_stack([rows[:, 0] - rows[0, 0] + moved, rows[:, 1:]])
        if rows[0, 0] <= joined[-1][-1, 0]:
            raise ValueError(
                f"{path}, line {segment.lines[0]}: this segment starts before the one of line "
                f"{before.lines[0]} ends; save the segments to separate files"
            )
        joined.append(rows)
    return np.concatenate(joined)


def _seconds_between(path, first: _Segment, later: _Segment) -> float:
    """Time (s) from the start of one segment to that of another, by their Date and Time."""
    starts = []
    for segment in (first, later):
        start = _start(segment)
        if start is None:
            date, time = (segment.header.get(key, [""])[0] for key in ("Date", "Time"))
            raise ValueError(
                f"{path}, line {segment.lines[0]}: the times of segments start again, but this "
                f"segment's Date {date!r} and Time {time!r} do not tell when it started"
            )
        starts.append(start)
    (day, part), (later_day, later_part) = starts
    return (later_day - day).total_seconds() + later_part - part


def _start(segment: _Segment) -> tuple[datetime, float] | None:
    """Date and time of the start of a segment in whole seconds, and the rest (s); None without."""
    date, time = (segment.header.get(key, [""])[0] for key in ("Date", "Time"))
    whole, _, fraction = time.replace(",", ".").partition(".")
    try:
        start = datetime.strptime(f"{date} {whole}", "%Y/%m/%d %H:%M:%S")
        return start, float(f"0.{fraction or 0}")
    except ValueError:
        return None


FORMAT = LogFormat(
    "LabVIEW (LVM)", read_lvm, suffixes=(".lvm",), magics=(MAGIC.encode(),), is_text=True
)
