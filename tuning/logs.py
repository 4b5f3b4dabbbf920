"""Logged runs: measured samples in SI units, and what is known about how they were made.

    log = read_log("run7.csv")                        # units in the headings: time [s], d1 [mm]
    log = read_log("run7.csv", units={"time": "s", "d1": "mm"}, columns=["d1"])

Beside a log there may be a TOML file of the same stem, which says what the log does not:

    time = "t"                                        # the column of times
    [columns]                                         # only these are read
    t = "ms"
    d1 = { unit = "mm", sensor = 0, position = 0.3 }  # which sensor of the case it is, and where
    u = { unit = "V", actuator = 0 }                  # the command to an actuator of the case
    [[loads]]                                         # as in a case file
    kind = "mass"
    mass = 0.5
    speed = 0.55
"""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbeam.loads import AbstractLoad
from tuning.readers import Table, lvm, read_csv, read_lvm
from tuning.sidecar import Sidecar, read_sidecar
from tuning.units import UNITS, unit

# Times may stray from an even grid by this share of a step: printed times are rounded.
EVEN = 0.25


@dataclass(frozen=True, eq=False)
class Log:
    """Samples of some channels over time, in SI units.

    `times` (time,) in s, strictly increasing; `values` (time, channel) in the SI unit of each
    channel's quantity; both are read-only. `quantities` are those of `jaxbeam.sensors.QUANTITIES`,
    or force (N) or voltage (V); `units` are as read, for labels. `sensors` and `positions` (m)
    say which sensor of a case each channel is and where, None where that is not known;
    `actuators` say to which actuator of a case a channel is the command, None for readings;
    `loads` are those that crossed while it was logged, None if that is not known.

    Raises ValueError if lengths disagree, a value is not finite or times do not increase.
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

    def __post_init__(self):
        channels = self.values.shape[1]
        for name in ("sensors", "positions", "actuators"):
            if not getattr(self, name):
                object.__setattr__(self, name, (None,) * channels)
        for name in ("names", "quantities", "units", "sensors", "positions", "actuators"):
            if len(getattr(self, name)) != channels:
                raise ValueError(
                    f"{self.source}: {len(getattr(self, name))} {name} for {channels} channels"
                )
        table = np.column_stack([self.times, self.values])
        check_samples(self.source, ("time", *self.names), table)
        for name in ("times", "values"):
            frozen = np.array(getattr(self, name))
            frozen.flags.writeable = False
            object.__setattr__(self, name, frozen)

    @property
    def duration(self) -> float:
        """Time from the first to the last sample in s."""
        return float(self.times[-1] - self.times[0])

    @property
    def sample_rate(self) -> float:
        """Samples per second in Hz, of a log sampled evenly.

        Raises ValueError, saying where, if times stray from an even grid by more than rounding.
        """
        even = np.linspace(self.times[0], self.times[-1], self.times.size)
        step = even[1] - even[0]
        stray = np.abs(self.times - even) / step
        if stray.max() > EVEN:
            raise ValueError(
                f"{self.source}: the log is not sampled evenly (at t = "
                f"{self.times[np.argmax(stray)]:.6g} s it is {stray.max():.2g} steps off an even "
                f"grid of {step:.4g} s); resample it to equal steps first"
            )
        return float(1 / step)


def read_log(
    path: str | Path,
    *,
    columns: Sequence[str] | None = None,
    units: Mapping[str, str] | str | None = None,
    time: str | None = None,
) -> Log:
    """Read a log from a file of separated values or a LabVIEW measurement file (.lvm).

    `columns` names the channels to keep, in this order; `units` gives the unit of columns by name
    (or one for all channels) and wins over the file; `time` names the column of times, by default
    the one called time or t, or the first with a unit of time. What is not given here is taken
    from the TOML file beside the log, then from the log itself. Sampling is that of the times.

    Raises ValueError, naming file and line, for an empty log, unknown columns or units, columns
    without a unit, cells that are not finite numbers, and times that do not increase.
    """
    path = Path(path)
    table = _read_table(path)
    side = read_sidecar(path)
    names = _named(path, table.names)
    clock = _time_column(path, table, time or side.time)
    channels = list(columns or side.columns or [name for name in names if name != clock])
    channels = [name for name in channels if name != clock]
    for name in (*channels, *side.columns, *(units if isinstance(units, Mapping) else ())):
        _check_column(path, name, names)
    if not channels:
        raise ValueError(f"{path}: there is no column besides the time, {clock!r}")
    declared = units if isinstance(units, Mapping) else dict.fromkeys(channels, units)
    found = [_unit_of(path, table, name, declared, side) for name in (clock, *channels)]
    if found[0][1].quantity != "time":
        raise ValueError(f"{path}: the column of times, {clock!r}, has the unit {found[0][0]!r}")
    values = table.values[:, [names.index(name) for name in (clock, *channels)]]
    values = values * np.array([unit.factor for _, unit in found])
    check_samples(str(path), (clock, *channels), values, table.lines)
    return Log(
        times=values[:, 0],
        values=values[:, 1:],
        names=tuple(channels),
        quantities=tuple(unit.quantity for _, unit in found[1:]),
        units=tuple(text for text, _ in found[1:]),
        source=str(path),
        sensors=tuple(side.sensor(name) for name in channels),
        positions=tuple(side.position(name) for name in channels),
        actuators=tuple(side.actuator(name) for name in channels),
        loads=side.loads,
    )


def check_samples(
    source: str,
    names: Sequence[str],
    values: Float[np.ndarray, "row column"],
    lines: Sequence[int] | np.ndarray | None = None,
) -> None:
    """Check that samples are finite and times, the first column, increase.

    Raises ValueError naming the line (or, without `lines`, the sample) and the column.
    """

    def place(row):
        return f"{source}, line {lines[row]}" if lines is not None else f"{source}, sample {row}"

    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        row, column = bad[0]
        raise ValueError(
            f"{place(row)}, column {names[column]!r}: {values[row, column]} is not a finite "
            "number; cut the log before or after it, or fill the gap"
        )
    if len(values) < 2:
        raise ValueError(f"{source}: a log needs at least two samples, this one has {len(values)}")
    steps = np.diff(values[:, 0])
    if np.any(steps <= 0):
        row = int(np.argmax(steps <= 0)) + 1
        what = "is repeated (are times printed with too few digits?)"
        if steps[row - 1] < 0:
            what = f"comes after {values[row - 1, 0]:.9g} s"
        raise ValueError(f"{place(row)}: time {values[row, 0]:.9g} s {what}; times must increase")


def _read_table(path: Path) -> Table:
    """Read by content where the format tells itself, else by suffix."""
    is_file = path.is_file()
    with_magic = is_file and path.read_bytes()[:32].lstrip(b"\xef\xbb\xbf").startswith(
        lvm.MAGIC.encode()
    )
    if with_magic or path.suffix.lower() == ".lvm":
        return read_lvm(path)
    if not is_file or path.suffix.lower() in (".csv", ".txt", ".tsv", ".dat"):
        return read_csv(path)
    raise ValueError(
        f"{path}: unknown kind of log {path.suffix!r}; known are .csv, .tsv, .txt, .dat and .lvm"
    )


def _named(path, names):
    """Return the column names, checked to be all there and all different."""
    for i, name in enumerate(names):
        if not name:
            raise ValueError(f"{path}: column {i + 1} has no name")
        if name in names[:i]:
            raise ValueError(f"{path}: two columns are called {name!r}; rename one of them")
    return names


def _check_column(path, name, names) -> None:
    if name in names:
        return
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    hint = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(names)}"
    raise ValueError(f"{path}: the log has no column {name!r}; {hint}")


def _time_column(path, table: Table, wanted: str | None) -> str:
    """Return the name of the column of times."""
    if wanted is not None:
        _check_column(path, wanted, table.names)
        return wanted
    if table.time is not None:
        return table.time
    for name in table.names:
        if name.lower() in ("time", "t", "zeit", "temps", "x_value"):
            return name
    for name, text in zip(table.names, table.units, strict=True):
        if text in UNITS and UNITS[text].quantity == "time":
            return name
    raise ValueError(
        f"{path}: no column is called time or has a unit of time; say which it is, "
        f'e.g. time={table.names[0]!r}, or time = "{table.names[0]}" in {path.stem}.toml'
    )


def _unit_of(path, table: Table, name: str, declared: Mapping[str, str | None], side: Sidecar):
    """Return the unit of a column, as text and as what it means."""
    in_file = table.units[table.names.index(name)]
    text = declared.get(name) or side.unit(name) or in_file
    if not text:
        raise ValueError(
            f"{path}, column {name!r}: no unit found; write it in the heading, {name} [mm], "
            f'pass units={{"{name}": "mm"}}, or put {name} = "mm" under [columns] '
            f"in {path.with_suffix('.toml').name}"
        )
    try:
        return text, unit(text)
    except ValueError as error:
        raise ValueError(f"{path}, column {name!r}: {error}") from None
