"""Description of a log, in a TOML file of the same stem: columns, units, sensors and loads."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.reading.tables import (
    COUNT,
    NUMBER,
    TABLE,
    TABLES,
    WORD,
    check_entry,
    check_table,
    read_parts,
)
from jaxbeam.case.reading.toml_file import read_toml
from jaxbeam.files.case_file import find_vehicle_files

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
