"""Tables of logged columns as read from files, and formats of files with their readers.

Channels of one run with clocks of their own are joined over the time that they have in common.
"""

import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbeam.runtime.input_file import check_input, describe_content, read_input
from jaxbeam.runtime.printer import counted
from tuning.logs.units import UNITS_OF_CONDITIONS, is_unit

# Names, in small letters, of numbers stored with the channels that define their times.
RATES = ("sample_rate", "sampling_rate", "samplerate", "fs", "rate")  # Hz
STEPS = ("dt", "time_step", "wf_increment")  # s
STARTS = ("start_time", "t0", "wf_start_offset")  # s
CUT = 0.05  # of the time in common: more that is cut off is said, also of slow channels
SAME = 0.01  # of a step: largest difference of equal start times, rounded to microseconds


class Clock(NamedTuple):
    """Time of the first sample and step of a channel, in s."""

    start: float
    step: float


def join_channels(
    source: str,
    channels: Mapping[str, np.ndarray],
    clocks: Mapping[str, Clock],
) -> tuple[Float[np.ndarray, " time"], dict[str, np.ndarray], list[str]]:
    """Common times (s) of the channels of one run, their values at these, and notes.

    Times are those of the channel with the shortest step, over the time that all have in common,
    from the start of the earliest. Others are interpolated (cubic spline) unless their samples are
    at these times.

    Raises ValueError for steps that are not positive, and channels without a time in common.
    """
    for name, clock in clocks.items():
        if not (0 < clock.step < np.inf and np.isfinite(clock.start)):
            raise ValueError(f"{source}: the sampling step of {name} is {clock.step:g} s")
    earliest = min(clock.start for clock in clocks.values())
    clocks = {name: Clock(one.start - earliest, one.step) for name, one in clocks.items()}
    ends = {n: one.start + one.step * (len(channels[n]) - 1) for n, one in clocks.items()}
    lead = min(clocks, key=lambda name: (clocks[name].step, clocks[name].start))
    step, slack = clocks[lead].step, SAME * clocks[lead].step
    longest = max(one.step for one in clocks.values())
    first = max(one.start for one in clocks.values())
    last = min(ends.values())
    spans = ", ".join(f"{n} {one.start:g} to {ends[n]:g} s" for n, one in clocks.items())
    low = int(np.ceil((first - clocks[lead].start) / step - SAME))
    high = int(np.floor((last - clocks[lead].start) / step + SAME))
    if high - low < 1:
        raise ValueError(
            f"{source}: its channels have no time in common: {spans}; save them to separate files"
        )
    times = clocks[lead].start + step * np.arange(low, high + 1)
    joined, interpolated = {}, []
    for name, (start, own) in clocks.items():
        values = channels[name]
        shift = (times[0] - start) / step
        if abs(own - step) * times.size < slack and abs(shift - round(shift)) < SAME:
            joined[name] = values[round(shift) : round(shift) + times.size]
            continue
        at = start + own * np.arange(len(values))
        joined[name] = at_times(at, values, times, (0.5 + SAME) * own)
        interpolated.append(f"{name} ({1 / own:.6g} Hz, {start:g} s)")
    said = []
    if first > slack or max(ends.values()) - last > min(longest - slack, CUT * last):
        said.append(
            f"its channels have different times ({_shortened(spans)}): aligned by them, and read"
            f" from {times[0]:g} to {times[-1]:g} s, which they have in common"
        )
    if interpolated:
        said.append(
            f"interpolated to {1 / step:.6g} Hz, from rates and starts of their own:"
            f" {_shortened(', '.join(interpolated))}"
        )
    return times, joined, said


def at_times(
    at: Float[np.ndarray, " sample"],
    values: np.ndarray,
    times: Float[np.ndarray, " time"],
    reach: float,
) -> np.ndarray:
    """Values at some times, by a cubic spline through the finite samples at the times `at` (s).

    NaN where none of these is within `reach` (s).
    """
    from scipy.interpolate import CubicSpline

    columns = []
    for column in values.reshape(at.size, -1).T:
        known = at[np.isfinite(column)]
        found = np.full(times.size, np.nan)
        if known.size > 1:
            after = np.clip(np.searchsorted(known, times), 1, known.size - 1)
            nearest = np.minimum(np.abs(times - known[after - 1]), np.abs(times - known[after]))
            near = nearest <= reach
            spline = CubicSpline(known, column[np.isfinite(column)])
            found[near] = spline(np.clip(times[near], known[0], known[-1]))
        columns.append(found)
    return np.stack(columns, axis=-1).reshape(times.size, *values.shape[1:])


def _shortened(text: str) -> str:
    return text if len(text) <= 300 else f"{text[:300]} ..."


def clocks_of(
    names: Sequence[str], starts: Mapping[str, float], steps: Mapping[str, float]
) -> dict[str, Clock]:
    """Clocks of channels; a channel without a step has the step of the first that has one."""
    step = next(iter(steps.values()))
    return {name: Clock(starts.get(name, 0.0), steps.get(name, step)) for name in names}


def clocks_by_numbers(
    source: str, numbers: Mapping[str, Mapping[str, float]], names: Sequence[str]
) -> dict[str, Clock] | None:
    """Clocks of channels by numbers stored with them, as `fs`; None without a rate.

    Raises ValueError for a rate that is not positive, and for a rate and a step that contradict
    each other.
    """
    starts, steps = {}, {}
    for name in names:
        own = numbers[name]
        rates = [own[one] for one in RATES if one in own]
        given = [own[one] for one in STEPS if one in own]
        if any(not 0 < one < np.inf for one in (*rates, *given)):
            raise ValueError(f"{source}: the sampling rate or step of {name} is not positive")
        found = [1 / rate for rate in rates] + given
        if found and max(found) > (1 + 1e-3) * min(found):
            raise ValueError(
                f"{source}: the sampling rates and steps of {name} contradict each other"
            )
        if found:
            steps[name] = found[0]
        starts[name] = next((own[one] for one in STARTS if one in own), 0.0)
    return clocks_of(names, starts, steps) if steps else None


_HEADING = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\[\]()]*)[\])]$")
_QUOTIENT = re.compile(r"^(?P<name>[^/]*?\S)(\s*/\s*|\s+in\s+)(?P<unit>\S+)$")
_FORTRAN = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+))[dD]([-+]?\d+)")
# Words of loggers, in small letters, for samples beyond the range and for none; signs around them
# are left out.
_SIGNS = "+-*#<>!. "
_NO_SAMPLE = frozenset(
    ["ovr", "ovrng", "ovf", "ovfl", "ol", "o.l", "over", "overload", "overflow", "overrange"]
    + ["over range", "over-range", "clip", "clipped", "n/a", "na", "null", "none", "num", "value"]
    + ["missing"]
)
MAX_SHOWN = 40  # characters of a cell in a message
MIN_CHANNEL_LENGTH = 0.1  # of the samples: shorter arrays are no channels, and may be left out
CHECKED_ROWS = 200  # at the end of a file, with which its last one is compared
TIME_NAMES = ("time", "t", "zeit", "temps", "x_value", "timestamp")


@dataclass(frozen=True, eq=False)
class LogTable:
    """Columns of one run in a log file, in the units of the file.

    `units` are those of the columns as named in the file, or None; `lines` the line numbers of the
    rows, None for a file without lines; `time` the name of the column of times, where the format
    defines it; `notes` sentences on how it was read, `warnings` those that the user must know: what
    is left out, moved or cut off. `has_headings` is False for columns without names in the file,
    which are called column 1, column 2, ... `start` is the date and time of the first sample.
    """

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    values: Float[np.ndarray, "row column"]
    lines: Int[np.ndarray, " row"] | None = None
    time: str | None = None
    notes: tuple[str, ...] = ()
    has_headings: bool = True
    warnings: tuple[str, ...] = ()
    start: str = ""


class LogFormat(NamedTuple):
    """A format of log files.

    `read` returns the tables of the runs in a file, by name (a single run is called ""). A file
    that begins with one of `magics` is of the format; so is a text file (`is_text`), or one of a
    format without `magics`, with one of the `suffixes`.
    """

    name: str
    read: Callable[[Path], dict[str, LogTable]]
    suffixes: tuple[str, ...]
    magics: tuple[bytes, ...] = ()
    is_text: bool = False


def parse_heading(text: str) -> tuple[str, str | None]:
    """Name and unit in the heading of a column, such as `d1 [mm]`; None without a unit.

    Also as quotients (ISO 80000-1) and in words, `d1/mm` and `d1 in mm`, of a known unit.

    >>> from tuning.logs.readers import parse_heading
    >>> [parse_heading(text) for text in ("t/ms", "a1 / m/s^2", "d1/d2", "m/s")]
    [('t', 'ms'), ('a1', 'm/s^2'), ('d1/d2', None), ('m/s', None)]
    """
    text = text.strip()
    found = _HEADING.match(text)
    if found is None and not is_unit(text):
        found = _QUOTIENT.match(text)
        found = found if found and is_unit(found["unit"]) else None
    return (found["name"], found["unit"]) if found else (text, None)


def table_of(
    source: str,
    arrays: Mapping[str, Any],
    units: Mapping[str, str | None],
    clocks: Mapping[str, Clock] | None = None,
    warnings: Sequence[str] = (),
    origin: float = 0.0,
) -> LogTable:
    """Table of the arrays of one run, by name; a name may be a heading with a unit.

    An array of several columns becomes `name.0`, `name.1`, ... Arrays with `clocks` are joined by
    them, where no column has times; the table has a date of its start if they are in s since 1970,
    or from an `origin` that is. Other arrays that are not as long as the times (or else as most of
    the arrays) are left out, with a warning if they may be channels.

    Raises ValueError if there are no numbers.
    """
    arrays = {name: np.asarray(array, float) for name, array in arrays.items()}
    own_times = [label for label in arrays if _is_time_label(label, units)]
    has_times = bool(own_times)
    times, said, start = None, list(warnings), ""
    if clocks and not has_times:
        timed = {label: upright(arrays[label]) for label in arrays if label in clocks}
        timed = {label: array for label, array in timed.items() if len(array) > 1}
        if timed:
            own = {label: clocks[label] for label in timed}
            times, joined, moved = join_channels(source, timed, own)
            arrays, said = arrays | joined, [*said, *moved]
            start = date_of(origin + min(one.start for one in own.values()) + float(times[0]))
    length = _length(arrays, own_times) if times is None else times.size
    if length < 2:
        raise ValueError(f"{source}: there is no list of numbers in it")
    names, found, columns, left_out, lost = [], [], [], [], False
    for label, array in arrays.items():
        if length not in array.shape or array.ndim > 2:
            left_out.append(f"{label} ({' x '.join(map(str, array.shape))})")
            lost |= max(array.shape, default=0) > MIN_CHANNEL_LENGTH * length
            lost |= label in (clocks or ()) and not has_times
            continue
        name, unit = parse_heading(label)
        flat = array.reshape(length, -1) if array.shape[0] == length else array.T
        single = flat.shape[1] == 1
        names += [name] if single else [f"{name}.{i}" for i in range(flat.shape[1])]
        found += [units.get(label) or unit] * flat.shape[1]
        columns.append(flat)
    others = [f"left out, not being {length} samples long: {', '.join(left_out)}"][: len(left_out)]
    said += others if lost else []
    values, time = np.hstack(columns), None
    if times is not None:
        time = "time"
        names, found = [time, *names], ["s", *found]
        values = np.column_stack([times, values])
    notes = () if lost else tuple(others)
    return LogTable(
        tuple(names),
        tuple(found),
        values,
        time=time,
        notes=notes,
        warnings=tuple(said),
        start=start,
    )


EPOCH, LATEST = 3e8, 1e10  # s since 1970: times between these are dates, from 1979 on
EPOCH_START = datetime(1970, 1, 1, tzinfo=UTC)


def date_of(seconds: float) -> str:
    """Date and time (ISO 8601) of seconds since 1970, "" for those that are no date."""
    if not EPOCH < seconds < LATEST:
        return ""
    return (EPOCH_START + timedelta(seconds=seconds)).isoformat(timespec="milliseconds")


def upright(array: np.ndarray) -> np.ndarray:
    """The array with time along its first axis, which is the longer one."""
    return array.T if array.ndim == 2 and array.shape[0] < array.shape[1] else array


def is_time_name(name: str, unit: str | None = None) -> bool:
    """Whether a name is one of a column of times, not of a temperature T (°C)."""
    return name.lower() in TIME_NAMES and unit not in UNITS_OF_CONDITIONS


def _is_time_label(label: str, units: Mapping[str, str | None]) -> bool:
    name, unit = parse_heading(label)
    return is_time_name(name, units.get(label) or unit)


def _length(arrays: Mapping[str, np.ndarray], times: Sequence[str]) -> int:
    """Number of samples: that of the times, or else that of most arrays."""
    if times:
        return max(arrays[times[0]].shape, default=0)
    sizes = [max(array.shape) for array in arrays.values() if array.ndim and array.size > 1]
    return max(sizes, key=lambda size: (sizes.count(size), size), default=0)


def read_bytes(path: Path, count: int | None = None) -> bytes:
    """Bytes of a file, or the first `count` of them.

    Raises ValueError if there is no such file, it is empty, too large, a folder, pipe or device.
    """
    if not path.exists():
        raise ValueError(f"{path}: there is no such log file")
    try:
        if count is None:
            data = read_input(path, "log")
        else:
            check_input(path, "log")
            with open(path, "rb") as file:
                data = file.read(count)
    except OSError as error:
        raise ValueError(str(error)) from None
    if not data:
        raise ValueError(f"{path}: the log is empty")
    return data


def read_text(path: Path) -> str:
    """Text of a file in UTF-8, UTF-16 or the Windows encoding (cp1252) of older loggers.

    Raises ValueError if there is no such file, it is empty, or it is no text.
    """
    data = read_bytes(path)
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):  # as Windows writes "Unicode"
        data = data.decode("utf-16", errors="replace").encode()
    if b"\0" in data:
        raise ValueError(
            f"{path}: this is no text but a binary file of an unknown format:"
            f" {describe_content(data)}"
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")
    if not text.strip():
        raise ValueError(f"{path}: the log is empty")
    return text


def text_attribute(attribute: Any) -> str | None:
    """Text of an attribute of a file; None for an empty one or another type."""
    if isinstance(attribute, bytes):
        attribute = attribute.decode(errors="replace")
    return attribute if isinstance(attribute, str) and attribute else None


def damaged_file_error(path: Path, error: Exception) -> ValueError:
    """Error for a file that the library which reads it cannot read, in one line."""
    words = "".join(letter if letter.isprintable() else " " for letter in str(error))
    why = textwrap.shorten(words, 150, placeholder=" ...") or type(error).__name__
    return ValueError(f"{path}: the file is damaged or cut off: {why}")


def parse_numbers(
    path: Path,
    names: Sequence[str],
    rows: Sequence[Sequence[str]],
    lines: Sequence[int],
    decimal_comma: bool,
) -> Float[np.ndarray, "row column"]:
    """Numbers in the cells of a table; cells that are empty or say OVR or the like become NaN.

    `lines` are the line numbers of the rows. Raises ValueError, naming file, line and column, for a
    cell that is no number, and for commas of which it is not sure that they are decimal ones.
    """
    if not rows:
        raise ValueError(f"{path}: the log is empty: there are column names but no rows")
    check_widths(path, names, rows, lines)
    if decimal_comma:
        rows = [[cell.replace(",", ".") for cell in row] for row in rows]
    try:
        return np.array(rows, dtype=float)
    except ValueError:
        pass
    numbers = [[number_of(cell) if cell.strip() else np.nan for cell in row] for row in rows]
    for found, row, line in zip(numbers, rows, lines, strict=True):
        if None in found:
            i = found.index(None)
            place = f"{path}, line {line}, column {shown(names[i])}"
            raise ValueError(f"{place}: {shown(row[i])} is no number")
    return np.array(numbers, dtype=float)


def number_of(cell: str) -> float | None:
    """Number in a cell, with decimal comma or point, or an exponent D; None if it is none.

    NaN for words of loggers that stand for no sample, as OVR.
    """
    text = cell.strip().replace(",", ".")
    try:
        return float(text)
    except ValueError:
        found = _FORTRAN.fullmatch(text)
        if found:
            return float(f"{found[1]}e{found[2]}")
        word = text.lower().strip(_SIGNS)
        # A sign alone is the unit of a number without one.
        return np.nan if word in _NO_SAMPLE or (not word and len(text) > 1) else None


def check_widths(
    path: Path, names: Sequence[str], rows: Sequence[Sequence[str]], lines: Sequence[int]
) -> None:
    """Check that each row has a cell for each column. Raises ValueError, naming the line."""
    for row, line in zip(rows, lines, strict=True):
        if len(row) != len(names):
            raise ValueError(
                f"{path}, line {line}: {counted(len(row), 'cell')} for"
                f" {counted(len(names), 'column')}"
            )


def check_last_line(
    path: Path, text: str, rows: Sequence[Sequence[str]], lines: Sequence[int]
) -> None:
    """Check that a file of text does not break off within its last row.

    It does if no end of line follows and the row has fewer cells than the others, or its last cell
    fewer decimals, which are as many in all others. Raises ValueError, naming the line.
    """
    if text.endswith(("\n", "\r")) or len(rows) < 3:
        return
    *others, last = [[cell.strip() for cell in row] for row in rows[-CHECKED_ROWS:]]
    decimals = {len(re.split("[.,]", row[-1])[-1]) if row else 0 for row in others}
    pointed = all(row and re.search("[.,]", row[-1]) for row in others)
    cells = min(map(len, others))
    is_short = pointed and len(decimals) == 1 and bool(last) and (
        len(re.split("[.,]", last[-1])[-1]) < min(decimals) if re.search("[.,]", last[-1]) else True
    )  # fmt: skip
    if len(last) < cells or is_short:
        raise ValueError(
            f"{path}, line {lines[-1]}: the file breaks off in its last line; delete that line"
        )


def shown(text: str) -> str:
    """A text in quotes, of at most MAX_SHOWN characters: a quote that is open swallows lines."""
    text = text.strip()
    return repr(text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN - 3]}...")
