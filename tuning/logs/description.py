"""Description of a log, in a TOML file of the same stem: columns, units, sensors and loads."""

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.files.case_file import read_part

_KEYS = ("loads", "columns", "time", "runs")
_COLUMN_KEYS = {
    "unit": (str, "a word"),
    "sensitivity": (str, 'like "100 mV/g"'),
    "sensor": (int, "an integer from 0"),
    "position": ((int, float), "a number in m"),
    "actuator": (int, "an integer from 0"),
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

    def actuator(self, name: str) -> int | None:
        """Index, in the case, of the actuator whose command a column is."""
        return self.columns.get(name, {}).get("actuator")

    def position(self, name: str) -> float | None:
        """Position (m) of the sensor of a column."""
        position = self.columns.get(name, {}).get("position")
        return None if position is None else float(position)


def read_description(log: Path) -> LogDescription:
    """Description in the TOML file beside a log, empty if there is none.

    Raises ValueError, naming file and key, for invalid TOML, unknown keys (with the nearest known
    one) and values of the wrong type.
    """
    path = log.with_suffix(".toml")
    if not path.is_file():
        return LogDescription()
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path}: {error}") from None
    if "beam" in data:  # a case file of the same stem
        return LogDescription()
    _check_keys(path, "", data, _KEYS)
    columns = {}
    for name, entry in data.get("columns", {}).items():
        entry = {"unit": entry} if isinstance(entry, str) else entry
        if not isinstance(entry, dict):
            raise ValueError(f'{path}, columns.{name}: give a unit, {name} = "mm", or a table')
        _check_keys(path, f"columns.{name}.", entry, _COLUMN_KEYS)
        _check_types(path, f"columns.{name}.", entry)
        columns[name] = entry
    loads = _loads(path, "", data) if "loads" in data else None
    runs = {}
    for name, entry in data.get("runs", {}).items():
        _check_keys(path, f"runs.{name}.", entry, ("loads",))
        runs[name] = _loads(path, f"runs.{name}.", entry)
    return LogDescription(data.get("time"), columns, loads, runs)


def _check_keys(path, prefix, data, known) -> None:
    for key in data:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
            raise ValueError(f"{path}: unknown key {prefix}{key}; {hint}")


def _check_types(path, prefix, entry) -> None:
    for key, value in entry.items():
        kind, description = _COLUMN_KEYS[key]
        if not isinstance(value, kind) or isinstance(value, bool):
            raise ValueError(f"{path}, {prefix}{key}: must be {description}, not {value!r}")


def _loads(path, prefix, table) -> tuple[AbstractLoad, ...]:
    """Loads from their tables, as in a case file."""
    try:
        return tuple(
            read_part(f"{prefix}loads.{i}", entry, AbstractLoad)
            for i, entry in enumerate(table.get("loads", ()))
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
