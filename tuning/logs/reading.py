"""Logs read from files, with their descriptions.

    log = read_log("run7.csv")                        # units in the headings: time [s], d1 [mm]
    log = read_log("run7.csv", units={"time": "s", "d1": "mm"}, columns=["d1"])

A TOML file of the same stem and folder describes a log (all entries are optional):

    time = "t"                                        # column of times
    [columns]                                         # only these are read
    t = "ms"
    d1 = { unit = "mm", sensor = 0, position = 0.3 }  # index of the sensor in the case
    a1 = { unit = "V", sensitivity = "100 mV/g" }     # output of a transducer
    a2 = { unit = "g", vehicle_sensor = 0 }           # index of the vehicle sensor in the case
    u = { unit = "V", actuator = 0 }                  # command to an actuator of the case
    [[loads]]                                         # as in a case file
    kind = "mass"
    mass = 0.5
    speed = 0.55
    [[runs.fast.loads]]                               # loads of one run of several
    kind = "mass"
    mass = 0.5
    speed = 2.0

A file may hold several runs: groups of a TDMS or HDF5 file, structs of a MATLAB file, or rows that
differ in a column called run. `read_logs` reads them all.

The description of a log is a TOML file of the same stem, with columns, units, sensors and loads.
"""

import dataclasses
import difflib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.tables import (
    COUNT,
    NUMBER,
    TABLE,
    TABLES,
    WORD,
    check_entry,
    check_table,
    read_parts,
)
from jaxbeam.case.toml_file import read_toml
from jaxbeam.files.case_file import find_vehicle_files
from tuning.logs.log import Log, LogWarning, check_samples, doubts, with_named_columns, with_times
from tuning.logs.quality import interpolate_invalid
from tuning.logs.readers import LogTable, is_time_name, read_tables
from tuning.logs.readers.table import EPOCH, LATEST, date_of, shown
from tuning.logs.units import UNITS_OF_CONDITIONS, is_of_time, is_unit, transducer_unit, unit

_KEYS = {"loads": TABLES, "columns": TABLE, "time": WORD, "runs": TABLE}
_COLUMN_KEYS = {
    "unit": WORD,
    "sensitivity": WORD._replace(description='like "100 mV/g"'),
    "sensor": COUNT,
    "vehicle_sensor": COUNT,
    "position": NUMBER._replace(description="a number in m"),
    "actuator": COUNT,
}


@dataclass(frozen=True)
class LogDescription:
    """Description of a log; empty without a file.

    `columns` has the entries of each column by its name; `runs` the loads of each run by its name.
    """

    time: str | None = None
    columns: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    loads: tuple[AbstractLoad, ...] | None = None
    runs: Mapping[str, tuple[AbstractLoad, ...]] = field(default_factory=dict)

    def loads_of(self, run: str) -> tuple[AbstractLoad, ...] | None:
        """Loads of a run of the file: its own, or else those of all runs."""
        return self.runs.get(run, self.loads)

    def sensitivity(self, name: str) -> str | None:
        """Sensitivity of the transducer of a column, such as `100 mV/g`."""
        return self.columns.get(name, {}).get("sensitivity")

    def unit(self, name: str) -> str | None:
        """Unit of a column."""
        return self.columns.get(name, {}).get("unit")

    def sensor(self, name: str) -> int | None:
        """Index, in the case, of the sensor of a column."""
        return self.columns.get(name, {}).get("sensor")

    def vehicle_sensor(self, name: str) -> int | None:
        """Index, among the vehicle sensors of the case, of the sensor of a column."""
        return self.columns.get(name, {}).get("vehicle_sensor")

    def actuator(self, name: str) -> int | None:
        """Index, in the case, of the actuator whose command a column is."""
        return self.columns.get(name, {}).get("actuator")

    def position(self, name: str) -> float | None:
        """Position (m) of the sensor of a column."""
        position = self.columns.get(name, {}).get("position")
        return None if position is None else float(position)


def read_description(log: Path) -> LogDescription:
    """Description of a log from the TOML file of the same stem; empty if there is none.

    Raises ValueError, naming file and key, for invalid TOML, unknown keys (with the nearest known
    one) and values of the wrong type.
    """
    path = log.with_suffix(".toml")
    if not path.exists():
        return LogDescription()
    data = read_toml(path, "description of a log")
    if "beam" in data:  # a case file of the same stem
        return LogDescription()
    try:
        find_vehicle_files(data.get("loads"), path.parent)
        for name, run in data["runs"].items() if isinstance(data.get("runs"), dict) else ():
            loads = run.get("loads") if isinstance(run, dict) else None
            find_vehicle_files(loads, path.parent, f"runs.{name}.loads")
        return _description(data)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def version_of(log: Path) -> str:
    """Sizes (bytes) and times of change (ns) of a log and its description, noted in stores."""
    about = (path.stat() for path in (log, log.with_suffix(".toml")) if path.is_file())
    return " ".join(f"{one.st_size}-{one.st_mtime_ns}" for one in about)


def _description(data: dict[str, Any]) -> LogDescription:
    """Description from the tables of its file."""
    check_table("", data, _KEYS)
    columns = {}
    for name, entry in data.get("columns", {}).items():
        entry = {"unit": entry} if isinstance(entry, str) else entry
        if not isinstance(entry, dict):
            raise ValueError(f'columns.{name}: give a unit, {name} = "mm", or a table')
        check_table(f"columns.{name}", entry, _COLUMN_KEYS)
        columns[name] = entry
    loads = _loads("", data) if "loads" in data else None
    runs = {}
    for name, entry in data.get("runs", {}).items():
        check_entry(f"runs.{name}", entry, TABLE)
        check_table(f"runs.{name}", entry, {"loads": TABLES})
        runs[name] = _loads(f"runs.{name}.", entry)
    return LogDescription(data.get("time"), columns, loads, runs)


def _loads(prefix: str, table: dict[str, Any]) -> tuple[AbstractLoad, ...]:
    """Loads from their tables, as in a case file."""
    return read_parts(f"{prefix}loads", table.get("loads", []), AbstractLoad)


WORKBOOK_DAYS = 25569  # days from 1899-12-30 to 1970
EPOCHS = {"ns": 3e17, "us": 3e14, "ms": 3e11, "s": EPOCH}  # least such time, by its unit
MAX_TEXT = 120  # characters of the name or the unit of a column, as messages quote it


def read_log(
    path: str | Path,
    *,
    columns: Sequence[str] | str | None = None,
    units: Mapping[str, str] | str | None = None,
    time: str | None = None,
    rate: float | None = None,
    run: str | None = None,
    missing: str = "refuse",
) -> Log:
    r"""Read a log: separated values, Excel, LabVIEW (.lvm, .tdms), universal files (.uff), MATLAB,
    HDF5, netCDF or Parquet.

    `columns` are the channels to keep, in this order, as a sequence or separated by commas, with
    units if the file has none: "time [s], a1 [g]". For a file without headings they are all its
    columns in their order, "-" for one that is not needed. `units` are the unit of columns by name
    (or one for all channels), which prevails over the file; `time` is the column of times, by
    default the one called time or t, or the first with a unit of time; `rate` (Hz) the sampling
    rate of a log without times. What is not given here is taken from the TOML file beside the log,
    then from the log itself. `run` is the name of the run in a file of several. Samples that are
    `missing` (empty cells, NaN) are refused or, with "mask", interpolated and left out of fits.

    Channels with other start times or rates are aligned and resampled. A `LogWarning` says so, and
    what else may make results wrong: channels that are left out, a recording that breaks off, jumps
    of the times, times in another unit than the file says.

    Raises ValueError, naming file and line, for an empty or damaged log, unknown columns or units,
    columns without a name or a unit, cells that are not finite numbers, times that do not increase,
    a rate beside a column of times, and several runs of which none is named.

    >>> from pathlib import Path
    >>> import tuning
    >>> _ = Path("run.csv").write_text("time [s],w1 [mm]\n0.0,0.0\n0.1,1.5\n0.2,0.5\n")
    >>> log = tuning.read_log("run.csv")
    >>> log.names, log.values[:, 0]
    (('w1',), array([0.    , 0.0015, 0.0005]))
    """
    runs = read_logs(
        path, columns=columns, units=units, time=time, rate=rate, run=run, missing=missing
    )
    if len(runs) > 1:
        names = ", ".join(repr(log.source.removeprefix(f"{path}:")) for log in runs)
        raise ValueError(f"{path}: it holds {len(runs)} runs, {names}; name one, or use read_logs")
    return runs[0]


def read_logs(
    path: str | Path,
    *,
    columns: Sequence[str] | str | None = None,
    units: Mapping[str, str] | str | None = None,
    time: str | None = None,
    rate: float | None = None,
    run: str | None = None,
    missing: str = "refuse",
) -> list[Log]:
    r"""Read all runs in a file, one log for each, with the options of `read_log`.

    Raises ValueError as `read_log` does, and for a `run` that is not in the file.

    >>> from pathlib import Path
    >>> import tuning
    >>> _ = Path("run.csv").write_text("time [s],w1 [mm]\n0.0,0.0\n0.1,1.5\n0.2,0.5\n")
    >>> [log.source for log in tuning.read_logs("run.csv")]
    ['run.csv']
    """
    if missing not in ("refuse", "mask"):
        raise ValueError(f'missing samples can be "refuse"d or "mask"ed, not {missing!r}')
    path = Path(path)
    tables = {}
    for name, table in read_tables(path).items():
        _check_texts(path, table)
        table = _with_distinct_names(table)
        table, channels, declared = with_named_columns(path, table, columns)
        table = with_times(path, table, rate, time)
        for part, rows in _split_runs(name, table).items():
            tables[part] = rows, channels, declared
    if run is not None and run not in tables:
        raise ValueError(f"{path}: it has no run {run!r}; it has {', '.join(map(repr, tables))}")
    description = read_description(path)
    if unknown := [name for name in description.runs if name not in tables]:
        raise ValueError(
            f"{path.with_suffix('.toml')}: runs.{unknown[0]} is no run of {path.name}; it has "
            f"{', '.join(map(repr, tables))}"
        )
    chosen = tables if run is None else {run: tables[run]}
    logs = []
    for name, (table, channels, declared) in chosen.items():
        asked = channels, declared if units is None else units, time, missing
        several = name if len(tables) > 1 else ""
        log, said = _make_log(path, several, table, description, *asked)
        for sentence in said:  # 3: blame the caller of `read_log`
            warnings.warn(f"{log.source}: {sentence}", LogWarning, stacklevel=3)
        logs.append(log)
    return logs


def _split_runs(name: str, table: LogTable) -> dict[str, LogTable]:
    """Tables of the runs of a table, by the values of its column `run`, if it has one."""
    if "run" not in table.names:
        return {name: table}
    keys = table.values[:, table.names.index("run")]
    return {
        f"{name}/{key:g}" if name else f"{key:g}": dataclasses.replace(
            table,
            values=table.values[keys == key],
            lines=None if table.lines is None else table.lines[keys == key],
        )
        for key in dict.fromkeys(keys.tolist())
    }


def _make_log(
    path, run, table: LogTable, description: LogDescription, columns, units, time, missing
) -> tuple[Log, list[str]]:
    """Log of one run, in SI units, and sentences of which its user is warned."""
    table = _without_repeats(table)
    names = _check_names(path, table.names)
    time_column = _time_column(path, table, time or description.time)
    channels = list(
        columns or description.columns or [name for name in names if name != time_column]
    )
    channels = [name for name in channels if name not in (time_column, "run")]
    for name in (*channels, *description.columns, *(units if isinstance(units, Mapping) else ())):
        _check_column(path, name, names)
    asked = columns or description.columns or units
    aside = [] if asked else _no_channels(table, channels, description)
    channels = [name for name in channels if name not in aside]
    if not channels:
        raise ValueError(f"{path}: there is no column besides the time, {time_column!r}")
    declared = units if isinstance(units, Mapping) else dict.fromkeys(channels, units)
    column_units = [
        _unit_of(path, table, name, declared, description, "s" if name == time_column else "mm")
        for name in (time_column, *channels)
    ]
    if column_units[0][1].quantity != "time":
        raise ValueError(
            f"{path}: the column of times, {time_column!r}, has the unit {column_units[0][0]!r}"
        )
    values = table.values[:, [names.index(name) for name in (time_column, *channels)]]
    clocks = [i for i, (_, found) in enumerate(column_units) if i and found.quantity == "time"]
    if clocks:  # of channels that have times of their own
        scaled = values * np.array([found.factor for _, found in column_units])
        for i in clocks:
            if not np.allclose(scaled[:, i], scaled[:, 0], rtol=1e-9, atol=1e-9, equal_nan=True):
                raise ValueError(
                    f"{path}: the columns {time_column!r} and {channels[i - 1]!r} are both times"
                    " and differ; read the channels of each by themselves, by time= and columns="
                )
        kept = [i for i in range(len(column_units)) if i not in clocks]
        values, column_units = values[:, kept], [column_units[i] for i in kept]
        channels = [channels[i - 1] for i in kept[1:]]
    began, factor = table.start, column_units[0][1].factor
    if (
        len(values) and EPOCH < factor * values[0, 0] < LATEST
    ):  # a date, by the seconds since 1970, or days of workbooks
        origin = WORKBOOK_DAYS * 86400.0 if column_units[0][0] == "d" else 0.0
        began = began or date_of(float(factor * values[0, 0]) - origin)
        values[:, 0] -= values[0, 0]
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is looked for below
        values = values * np.array([unit.factor for _, unit in column_units])
    valid, notes = np.isfinite(values), [*table.notes]
    if missing == "mask":
        values[:, 1:] = interpolate_invalid(values[:, 0], values[:, 1:], valid[:, 1:])
        notes += [
            f"{count} missing samples of {name} are left out"
            for name, count in zip(channels, np.sum(~valid[:, 1:], axis=0), strict=True)
            if count
        ]
    source = f"{path}:{run}" if run else str(path)
    check_samples(source, (time_column, *channels), values, table.lines)
    conditions = _conditions(table, aside)
    unit_of_times = column_units[0][0]
    given = declared.get(time_column) or description.unit(time_column)
    sure = table.time is not None or bool(given)
    said = [
        *table.warnings,
        *_left_out(table, aside),
        *doubts(channels, values[:, 0], values[:, 1:], table.lines, unit_of_times, sure),
    ]
    log = Log(
        times=values[:, 0],
        values=values[:, 1:],
        names=tuple(channels),
        quantities=tuple(unit.quantity for _, unit in column_units[1:]),
        units=tuple(text for text, _ in column_units[1:]),
        source=source,
        sensors=tuple(description.sensor(name) for name in channels),
        positions=tuple(description.position(name) for name in channels),
        actuators=tuple(description.actuator(name) for name in channels),
        vehicle_sensors=tuple(description.vehicle_sensor(name) for name in channels),
        loads=description.loads_of(run),
        valid=valid[:, 1:],
        notes=(*notes, *said),
        start=began,
        conditions=tuple(conditions.items()),
    )
    return log, said


def _with_distinct_names(table: LogTable) -> LogTable:
    """The table with columns of equal names renamed, as a1 and a1 (2), with a warning."""
    if len(set(table.names)) == len(table.names):
        return table
    names: list[str] = []
    for name in table.names:
        count, own = 1, name
        while name and own in names:
            count += 1
            own = f"{name} ({count})"
        names.append(own)
    new = ", ".join(name for name in names if name not in table.names)
    said = f"columns of equal names are renamed: {new}"
    return dataclasses.replace(table, names=tuple(names), warnings=(*table.warnings, said))


def _without_repeats(table: LogTable) -> LogTable:
    """The table without rows that repeat earlier ones, with a warning."""
    values = table.values
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    again = np.flatnonzero(same.all(axis=1)) + 1
    if not again.size or values.shape[1] < 2:
        return table
    lines = None if table.lines is None else np.delete(table.lines, again)
    where = "" if table.lines is None else f", the first in line {table.lines[again[0]]}"
    said = f"{again.size} rows repeat the one before and are left out{where}"
    return dataclasses.replace(
        table, values=np.delete(values, again, axis=0), lines=lines,
        warnings=(*table.warnings, said),
    )  # fmt: skip


def _no_channels(
    table: LogTable, channels: Sequence[str], description: LogDescription
) -> list[str]:
    """Columns that are no channels: units that are no SI quantity, as of temperatures.

    And not in the description of the log. Columns without a unit belong to them where others have
    one. Empty where no channel would be left: then a unit is misspelt.
    """
    units = dict(zip(table.names, table.units, strict=True))
    unknown = [
        name
        for name in channels
        if not is_unit(str(units[name] or "")) and not description.unit(name)
    ]
    return unknown if len(unknown) < len(channels) else []


def _left_out(table: LogTable, names: Sequence[str]) -> Iterator[str]:
    """Sentences on columns that are neither channels nor conditions such as temperatures."""
    for name in names:
        text = table.units[table.names.index(name)]
        if not text:
            yield f"column {name!r} is no channel, having no unit; write it in the heading"
        elif text not in UNITS_OF_CONDITIONS:
            try:
                unit(text)
            except ValueError as error:
                yield f"column {name!r} is no channel: {error}"


def _conditions(table: LogTable, names: Sequence[str]) -> dict[str, float]:
    """Means of columns by name and unit; without those that have no number."""
    found = {}
    for name in names:
        i = table.names.index(name)
        finite = table.values[np.isfinite(table.values[:, i]), i]
        if finite.size:
            unit_of = f" ({table.units[i]})" if table.units[i] else ""
            found[f"{name}{unit_of}"] = float(finite.mean())
    return found


def _check_texts(path, table: LogTable) -> None:
    """Validate that names and units are short: messages quote them, and damaged files have any."""
    for what, texts in (("name", table.names), ("unit", table.units)):
        for i, text in enumerate(texts):
            if text is not None and len(repr(text)) > MAX_TEXT:
                raise ValueError(
                    f"{path}: the {what} of column {i + 1} has {len(text)} characters,"
                    f" {shown(text)}; the file is damaged, or give it a shorter one"
                )


def _check_names(path, names):
    """Column names, checked to be complete."""
    for i, name in enumerate(names):
        if not name:
            raise ValueError(f"{path}: column {i + 1} has no name")
    return names


def _check_column(path, name, names) -> None:
    if name in names:
        return
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    hint = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(names)}"
    raise ValueError(f"{path}: the log has no column {name!r}; {hint}")


def _time_column(path, table: LogTable, requested: str | None) -> str:
    """Name of the column of times."""
    if requested is not None:
        _check_column(path, requested, table.names)
        return requested
    if table.time is not None:
        return table.time
    units = dict(zip(table.names, table.units, strict=True))
    for name, text in units.items():
        if is_time_name(name, text):
            return name
    for name, text in units.items():
        if is_of_time(text):
            return name
    raise ValueError(
        f"{path}: no column is called time or has a unit of time; say which it is, "
        f'time = "{table.names[0]}" in {path.stem}.toml, or read_log(..., '
        f"time={table.names[0]!r}); of a log without times give the sampling rate (modes-from-log "
        "--rate, or read_log(..., rate=))"
    )


def _unit_of(
    path,
    table: LogTable,
    name: str,
    declared: Mapping[str, str | None],
    description: LogDescription,
    example: str,
):
    """Unit of a column, as text and as `Unit`; an error names the `example` of one."""
    in_file = table.units[table.names.index(name)]
    text = declared.get(name) or description.unit(name) or in_file
    if not text and is_time_name(name):
        first = float(table.values[0, table.names.index(name)]) if len(table.values) else 0.0
        text = next((u for u, least in EPOCHS.items() if first > least), None)
        # Variables of numerical programs have no unit of time; `doubts` checks the steps.
        text = text or ("s" if table.lines is None else None)
    if not text:
        raise ValueError(
            f"{path}, column {name!r}: no unit found; write it in the heading, {name} [{example}], "
            f'pass units={{"{name}": "{example}"}}, or put {name} = "{example}" under [columns] '
            f"in {path.with_suffix('.toml').name}"
        )
    try:
        logged, sensitivity = unit(text), description.sensitivity(name)
        return text, transducer_unit(sensitivity, logged) if sensitivity else logged
    except ValueError as error:
        raise ValueError(f"{path}, column {name!r}: {error}") from None
