"""Logs of measured runs: samples in SI units, with their sensors, commands and loads.

Evenly sampled records of a log: split at gaps, resampled where the clock wanders.

Columns of a table that the user names, and times from a sampling rate.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.fields import OUTSIDE, refuse_traced
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.runtime.printer import counted
from tuning.logs.readers import LogTable, is_time_name, parse_heading
from tuning.logs.units import is_of_time

GAP_STEPS = 1.5  # usual steps between two samples, beyond which samples are missing
MAX_GRID_DEVIATION_STEPS = 0.25  # steps between times and an even grid, for rounded times
MAX_SIZE = 1e30  # of a sample in its SI unit; bytes in the wrong order are larger
# Steps (s) of a log of vibrations: slower and faster ones are times in another unit than is said.
PLAUSIBLE_STEPS = (1.5e-5, 0.11)
MIN_SAMPLES = 8  # of a log whose steps are checked
USUAL_STEPS = (2e-4, 0.02)  # steps (s) that the likely unit would give
SCALES = {"ms": 1e-3, "us": 1e-6, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
# Times in minutes that are read as seconds look like those of fast loggers. Rates (Hz) of fast
# loggers belong to series: powers of two, and some numbers times powers of two or of ten.
FAST_RATE = 2500.0  # Hz: rates from which on are compared with these series
DOUBLED = (1.0, 25.0, 75.0)  # 12 800, 25 600, 51 200 and 1200, 2400, 4800 Hz, say
DECIMAL = (1.0, 2.0, 2.5, 4.0, 5.0, 8.0)
OTHERS = (22050.0, 44100.0, 96000.0, 192000.0)  # of sound cards
RATE_TOLERANCE = 1e-3  # of a rate: times are rounded


class LogWarning(UserWarning):
    """Warning about the way in which a log was read, or about its times."""


@dataclass(frozen=True, eq=False, repr=False)
class Log:
    """Samples of some channels over time, in SI units.

    `times` in s increase strictly; `values` are in the SI unit of each channel's quantity; both are
    read-only. `quantities` are those of sensors (`jaxbeam.case.sensors`), "force" (N) or
    "voltage" (V); `units` are those of the file, for labels. `sensors` and `positions` (m) are the
    index and position of the sensor of the case that a channel is, None if unknown; `actuators` the
    index of the actuator whose command it is, None for readings; `vehicle_sensors` the index of the
    sensor on a vehicle; `loads` are those that crossed, None if unknown. Samples that are not
    `valid` (time, channel) are left out of fits, by default none. `notes` are sentences on how the
    log was read; `start` is the date and time of its first sample, if the file has one.
    `conditions` are means of columns that are no channels, as temperatures, by their headings.

    Raises ValueError if lengths disagree, a value is not finite or times do not increase.

    >>> import numpy as np
    >>> import tuning
    >>> times = np.linspace(0.0, 2.0, 401)
    >>> log = tuning.Log(
    ...     times, np.sin(times)[:, None], ("w1",), ("deflection",), ("m",), sensors=(0,)
    ... )
    >>> print(log.duration, "s at", log.sample_rate, "Hz")
    2.0 s at 200.0 Hz
    """

    times: Float[np.ndarray, " time"]
    values: Float[np.ndarray, "time channel"]
    names: tuple[str, ...]
    quantities: tuple[str, ...]
    units: tuple[str, ...]
    source: str = "log"
    sensors: tuple[int | None, ...] = ()
    positions: tuple[float | None, ...] = ()
    actuators: tuple[int | None, ...] = ()
    loads: tuple[AbstractLoad, ...] | None = None
    valid: Bool[np.ndarray, "time channel"] | None = None
    notes: tuple[str, ...] = ()
    vehicle_sensors: tuple[int | None, ...] = ()
    start: str = ""
    conditions: tuple[tuple[str, float], ...] = ()

    def __post_init__(self):
        refuse_traced("a log", OUTSIDE, self.times, self.values)
        shapes = np.shape(self.times), np.shape(self.values)
        if len(shapes[1]) != 2 or shapes[0] != shapes[1][:1]:
            raise ValueError(
                f"{self.source}: times must be (time,) and values (time, channel), not of the"
                f" shapes {shapes[0]} and {shapes[1]}"
            )
        for name in ("times", "values"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), float))
        channels = self.values.shape[1]
        if self.valid is None:
            object.__setattr__(self, "valid", np.ones(self.values.shape, bool))
        for name in ("sensors", "positions", "actuators", "vehicle_sensors"):
            if not getattr(self, name):
                object.__setattr__(self, name, (None,) * channels)
        per_channel = ("names", "quantities", "units", "sensors", "positions", "actuators")
        for name in (*per_channel, "vehicle_sensors"):
            if len(getattr(self, name)) != channels:
                raise ValueError(
                    f"{self.source}: {len(getattr(self, name))} {name} for {channels} channels"
                )
        table = np.column_stack([self.times, self.values])
        check_samples(self.source, ("time", *self.names), table)
        for name in ("times", "values", "valid"):
            frozen = np.array(getattr(self, name))
            frozen.flags.writeable = False
            object.__setattr__(self, name, frozen)

    def __repr__(self) -> str:
        """What was read: samples, duration, channels with units in the file and their sensors."""
        lines = [
            f"Log {self.source}: {counted(self.times.size, 'sample')} in {self.duration:.6g} s"
        ]
        parts = {"sensor": self.sensors, "actuator": self.actuators, "at": self.positions}
        for i, channel in enumerate(zip(self.names, self.quantities, self.units, strict=True)):
            of_case = [f"{word} {own[i]:g}" for word, own in parts.items() if own[i] is not None]
            name, quantity, unit = channel
            lines.append(", ".join([f"  {name}: {quantity} in {unit}", *of_case]))
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])

    @property
    def duration(self) -> float:
        """Time from the first to the last sample in s."""
        return float(self.times[-1] - self.times[0])

    @property
    def sample_rate(self) -> float:
        """Sampling rate (Hz) of a log sampled evenly.

        Raises ValueError, with the time, if times are off an even grid by more than rounding.
        """
        even_grid = np.linspace(self.times[0], self.times[-1], self.times.size)
        step = even_grid[1] - even_grid[0]
        deviation = np.abs(self.times - even_grid) / step
        if deviation.max() > MAX_GRID_DEVIATION_STEPS:
            raise ValueError(
                f"{self.source}: the log is not sampled evenly (at t = "
                f"{self.times[np.argmax(deviation)]:.6g} s it is {deviation.max():.2g} steps off "
                f"an even grid of {step:.4g} s); resample it to equal steps first"
            )
        return float(1 / step)


def check_samples(
    source: str,
    names: Sequence[str],
    values: Float[np.ndarray, "row column"],
    lines: Sequence[int] | np.ndarray | None = None,
) -> None:
    """Check that samples are finite and times, the first column, increase.

    Raises ValueError naming the line (or, without `lines`, the sample) and the column.
    """

    def where(row):
        return f"{source}, line {lines[row]}" if lines is not None else f"{source}, sample {row}"

    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        row, column = bad[0]
        value = values[row, column]
        what = "the cell is empty, or says nan" if np.isnan(value) else f"{value} is not finite"
        raise ValueError(
            f"{where(row)}, column {names[column]!r}: {what}; fill in what was measured, cut the "
            'log there, or leave such samples out, by missing="mask" or --missing mask'
        )
    huge = np.argwhere(np.abs(values) > MAX_SIZE)
    if huge.size:
        row, column = huge[0]
        raise ValueError(
            f"{where(row)}, column {names[column]!r}: {values[row, column]:.3g} is no measurement;"
            " the file is damaged, or its bytes are in the wrong order"
        )
    if len(values) < 2:
        raise ValueError(f"{source}: a log needs at least two samples, this one has {len(values)}")
    steps = np.diff(values[:, 0])
    if np.any(steps <= 0):
        row = int(np.argmax(steps <= 0)) + 1
        what = "is repeated (are times printed with too few digits?)"
        if steps[row - 1] < 0:
            what = f"comes after {values[row - 1, 0]:.9g} s"
        raise ValueError(f"{where(row)}: time {values[row, 0]:.9g} s {what}; times must increase")


def doubts(
    names: Sequence[str],
    times: Float[np.ndarray, " time"],
    values: Float[np.ndarray, "time channel"],
    lines: Sequence[int] | np.ndarray | None = None,
    time_unit: str = "s",
    time_unit_is_sure: bool = False,
) -> Iterator[str]:
    """Sentences on likely faults of a log: jumps and scale of its times, equal channels.

    `lines` are the line numbers of the samples in the file, `time_unit` is its unit of times, which
    is sure where the format defines it or the user has given it.
    """
    steps = np.diff(times)
    usual = float(np.median(steps))
    jumps = np.flatnonzero(steps > GAP_STEPS * usual)
    if jumps.size:
        first, lost = jumps[0], np.sum(np.round(steps[jumps] / usual) - 1)
        where = f", line {lines[first + 1]}" if lines is not None else ""
        often = "" if jumps.size == 1 else f"; {jumps.size} such jumps"
        yield (
            f"times jump by {steps[first]:.4g} s after t = {times[first]:.6g} s{where}, with steps"
            f" of {usual:.4g} s elsewhere{often}: about {lost:.0f} samples are missing"
        )
    if times.size >= MIN_SAMPLES and not PLAUSIBLE_STEPS[0] <= usual <= PLAUSIBLE_STEPS[1]:
        given = SCALES.get(time_unit, 1.0)
        likely = [
            unit
            for unit, scale in SCALES.items()
            if unit != time_unit and USUAL_STEPS[0] <= usual / given * scale <= USUAL_STEPS[1]
        ]
        guess = f": are they in {likely[0]}, not in {time_unit}?" if likely else ""
        yield f"times are {usual:.4g} s apart, {1 / usual:.4g} samples a second{guess}"
    elif times.size >= MIN_SAMPLES and not time_unit_is_sure and not jumps.size:
        rate = (times.size - 1) / float(times[-1] - times[0])
        if rate > FAST_RATE and not _is_of_series(rate) and _is_of_series(rate / SCALES["min"]):
            yield (
                f"times are {1 / rate:.4g} s apart, {rate:.4g} samples a second: are they in min,"
                f" not in {time_unit}? (no doubt if you give the unit, by units= or beside the log)"
            )
    first_of: dict[bytes, str] = {}
    for name, column in zip(names, values.T, strict=True):
        other = first_of.setdefault(column.tobytes(), name)
        if other != name and np.ptp(column) > 0:
            yield f"{name} equals {other} in every sample: is one of them a copy?"


def _is_of_series(rate: float) -> bool:
    """Whether a rate (Hz) belongs to the series of rates of loggers."""
    doubled = np.outer(DOUBLED, 2.0 ** np.arange(21))
    decimal = np.outer(DECIMAL, 10.0 ** np.arange(7))
    series = np.concatenate([doubled.ravel(), decimal.ravel(), OTHERS])
    return bool(np.any(np.abs(series / rate - 1) < RATE_TOLERANCE))


MIN_RECORD_SAMPLES = 64


class EvenRecord(NamedTuple):
    """Samples at even steps: the time of the first (s), and the values (time, channel)."""

    start: float
    values: Float[np.ndarray, "time channel"]


def even_records(log: Log) -> tuple[float, tuple[EvenRecord, ...], tuple[str, ...]]:
    """Sampling rate (Hz), the evenly sampled records of a log between its gaps, and notes.

    All records have one rate, that of the usual step. Times off an even grid by more than rounding
    are interpolated (cubic spline) to the grid.

    Raises ValueError for a log whose records between gaps are all too short.
    """
    step, parts = between_gaps(log.times)
    records, notes, resampled, dropped = [], [], 0.0, 0
    for start, stop in parts:
        if stop - start < MIN_RECORD_SAMPLES:
            dropped += 1
            continue
        times, values = log.times[start:stop], log.values[start:stop]
        grid = times[0] + step * np.arange(round((times[-1] - times[0]) / step) + 1)
        count = min(grid.size, times.size)
        deviation = np.max(np.abs(times[:count] - grid[:count])) / step
        if grid.size != times.size or deviation > MAX_GRID_DEVIATION_STEPS:
            from scipy.interpolate import CubicSpline

            grid = grid[grid <= times[-1]]
            values = CubicSpline(times, values, axis=0)(grid)
            resampled = max(resampled, float(deviation))
        records.append(EvenRecord(float(times[0]), values))
    if not records:
        raise ValueError(
            f"{log.source}: after {counted(len(parts) - 1, 'gap')} no record has"
            f" {MIN_RECORD_SAMPLES} samples"
        )
    if len(parts) > 1:
        used = "1 record is used" if len(records) == 1 else f"{len(records)} records are used"
        less = f", {dropped} of less than {MIN_RECORD_SAMPLES} samples left out" if dropped else ""
        notes.append(f"{counted(len(parts) - 1, 'gap')}: {used}{less}")
    if resampled:
        notes.append(
            f"times are up to {resampled:.2g} steps off an even grid of {step:.6g} s: interpolated"
        )
    return 1 / step, tuple(records), tuple(notes)


def between_gaps(times: Float[np.ndarray, " time"]) -> tuple[float, list[tuple[int, int]]]:
    """Step (s) of some times, and the first and last (exclusive) sample of each part without gap.

    >>> import numpy as np
    >>> from tuning.logs.log import between_gaps
    >>> between_gaps(np.array([0.0, 1.0, 2.0, 7.0, 8.0]))
    (1.0, [(0, 3), (3, 5)])
    """
    steps = np.diff(times)
    usual = np.median(steps)
    # The median of rounded steps is one of the rounded steps; their mean without gaps is not.
    cuts = np.flatnonzero(steps > GAP_STEPS * usual) + 1
    within = np.delete(steps, cuts - 1)
    step = float(np.mean(within)) if within.size else float(usual)
    edges = [0, *cuts.tolist(), times.size]
    return step, list(zip(edges[:-1], edges[1:], strict=True))


SKIPPED = "-"  # name that leaves a column out


def with_named_columns(
    path: Path, table: LogTable, columns: Sequence[str] | str | None
) -> tuple[LogTable, list[str] | None, dict[str, str]]:
    """The table with names for columns that have none, the channels wanted, and units given.

    `columns` are headings, such as `a1 [g]`, as a sequence or separated by commas.

    Raises ValueError for a table without headings if no columns, or another number, are given.
    """
    headings = columns.split(",") if isinstance(columns, str) else list(columns or ())
    parsed = [parse_heading(heading) for heading in headings]
    if table.has_headings:
        # A name with brackets may be one of the file; otherwise they hold the unit.
        names = [h.strip() if h.strip() in table.names else n
                 for h, (n, _) in zip(headings, parsed, strict=True)]  # fmt: skip
        units = {own: u for n, (own, u) in zip(names, parsed, strict=True) if u and n == own}
        return table, names or None, units
    count = len(table.names)
    line = "" if table.lines is None else f", line {table.lines[0]}"
    example = ", ".join(["time [s]", *(f"a{i} [g]" for i in range(1, count))])
    if not headings:
        raise ValueError(
            f"{path}{line}: the file has no headings; name its {count} columns, with units, e.g. "
            f'columns="{example}" (--columns), or write them into its first line'
        )
    if len(headings) != count:
        raise ValueError(
            f"{path}{line}: {len(headings)} columns are named, but the file has {count}; name all, "
            f'e.g. columns="{example}", or "{SKIPPED}" for one that is not needed'
        )
    kept = [i for i, (name, _) in enumerate(parsed) if name != SKIPPED]
    table = dataclasses.replace(
        table,
        names=tuple(parsed[i][0] for i in kept),
        units=tuple(parsed[i][1] for i in kept),
        values=table.values[:, kept],
        has_headings=True,
    )
    return table, None, {}


def with_times(path: Path, table: LogTable, rate: float | None, time: str | None) -> LogTable:
    """The table with times from a sampling rate (Hz); unchanged without one.

    Raises ValueError for a rate that is not positive and for a table that has times.
    """
    if rate is None:
        return table
    if not 0 < rate < np.inf:
        raise ValueError(f"{path}: the sampling rate must be positive, not {rate:g} Hz")
    named = time or table.time or next(
        (
            name
            for name, unit in zip(table.names, table.units, strict=True)
            if is_time_name(name, unit) or is_of_time(unit)
        ),
        None,
    )  # fmt: skip
    if named is not None:
        raise ValueError(
            f"{path}: the log has a column of times, {named!r}; leave the sampling rate out, or "
            "read the file without that column"
        )
    times = np.arange(len(table.values)) / rate
    return dataclasses.replace(
        table,
        names=("time", *table.names),
        units=("s", *table.units),
        values=np.column_stack([times, table.values]),
        time="time",
    )
