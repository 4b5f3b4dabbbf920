"""Views of records: text, tables, labelled datasets, figures and files."""

import abc
import json
import os
from collections.abc import Callable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jaxbeam.case.case import Case
from jaxbeam.case.display import with_prefix
from jaxbeam.case.fields import refuses_traced
from jaxbeam.case.sensors import sensor_labels
from jaxbeam.files.case_file import case_to_dict
from jaxbeam.files.endings import check_ending
from jaxbeam.files.netcdf import write_netcdf
from jaxbeam.files.report import interactive_page
from jaxbeam.files.tables import write_result
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modes import Modes
from jaxbeam.runtime.arrays import Array, Module, any_traced
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.runtime.printer import TableViews, html_table, labelled_dataset, text_table
from jaxbeam.simulation.errors import Extremes
from jaxbeam.simulation.labels import (
    ACTING_COMMAND,
    FURTHER_SERIES,
    MODE_FIELDS,
    MODE_VARIABLES,
    OF_ABSORBERS,
    OF_FLIGHTS,
    VARIABLES,
    sensor_coordinates,
    wheel_labels,
)

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure, SubFigure

    from jaxbeam.case.case import Case


def dataset_parts(
    case: Case, modes: Modes, times, bodies: Sequence[str], value: Callable[[str], Any]
) -> tuple[dict, dict, dict]:
    """Variables, coordinates and attributes of the dataset of a record.

    `bodies` are names of degrees of freedom of vehicles; `value` returns what the record has under
    the name of a variable or attribute.
    """
    variables = {
        name: (dims, np.asarray(value(name)), {"units": unit, "long_name": words})
        for name, (dims, unit, words) in VARIABLES.items()
    }
    supports, reactions = np.asarray(value("support_positions")), np.asarray(value("reactions"))
    if supports.size:
        labels = {"units": "N", "long_name": "reaction of the support, positive upwards"}
        variables["reaction"] = (("time", "support"), reactions, labels)
    if case.absorbers:
        variables |= {
            name: (dims, np.asarray(value(name)), {"units": unit, "long_name": words})
            for name, (dims, unit, words) in OF_ABSORBERS.items()
        }
    if (flights := value("flights")) is not None:
        variables |= {
            f"flight_{name}": (
                "flight",
                np.asarray(getattr(flights, name), float),
                {"units": unit, "long_name": words},
            )
            for name, (unit, words) in OF_FLIGHTS.items()
        }
    # Modes of repeated frequencies are not unique, so they are stored.
    variables |= {
        f"mode_{name}": (
            dims,
            np.asarray(getattr(modes, MODE_FIELDS.get(name, name))),
            {"units": unit, "long_name": words},
        )
        for name, (dims, unit, words) in MODE_VARIABLES.items()
    }
    for name, (unit, words) in FURTHER_SERIES.items():
        if (series := getattr(modes, name)) is not None:
            labels = {"units": unit, "long_name": words}
            dims = "segment", "degree", "mode"
            variables[f"mode_{name}"] = (dims, np.asarray(series), labels)
    if (acting := value("acting_command")) is not None:
        dims, unit, words = ACTING_COMMAND
        labels = {"units": unit, "long_name": words}
        variables["acting_command"] = (dims, np.asarray(acting), labels)
    coordinates = {
        "time": ("time", np.asarray(times), {"units": "s"}),
        **sensor_coordinates(case),
        "load": ("load", wheel_labels(load_set(case))),
        "body": ("body", np.array(bodies, dtype=str)),
        **({"support": ("support", supports, {"units": "m"})} if supports.size else {}),
        "frequency": ("mode", np.asarray(modes.frequencies), {"units": "Hz"}),
    }
    attributes = {
        "title": case.title,
        "case": json.dumps(case_to_dict(case)),
        "error_estimate": float(value("error_estimate")),
        **({} if value("result") is None else {"result": int(value("result"))}),
        "steps": value("steps"),
        "verdict": value("verdict"),
    }
    return variables, coordinates, attributes


def record_columns(
    case: "Case", times, sensor_values, contact_force, command
) -> dict[str, Float[np.ndarray, " time"]]:
    """Columns by head: time, what each sensor measures, contact forces of wheels, commands.

    `sensor_values` (time, sensor) and `command` (time, actuator) are in the units of their sensors
    and actuators, `contact_force` (time, load) in N.
    """
    columns = {"time (s)": np.asarray(times)}
    for i, sensor in enumerate(case.sensors):
        head = f"{sensor.name or f'sensor {i}'} {sensor.quantity}{_in_brackets(sensor.unit)}"
        head = f"sensor {i} {head}" if head in columns else head  # of equal names
        columns[head] = sensor_values[:, i]
    for i, label in enumerate(wheel_labels(load_set(case))):
        columns[f"load {label} contact force (N)"] = contact_force[:, i]
    for i, actuator in enumerate(case.actuators):
        columns[f"actuator {i} command{_in_brackets(actuator.command_unit)}"] = command[:, i]
    return {head: np.asarray(column) for head, column in columns.items()}


def _in_brackets(unit: str) -> str:
    return "" if unit == "1" else f" ({unit})"


HEADER = ("sensor", "position", "quantity", "smallest", "at", "largest", "at")
MAX_SENSORS = 12  # with a row each


def record_text(case: Case, times, verdict: str, extremes: Extremes) -> str:
    """Title, duration and loads of a run, its verdict, and a row of extremes for each sensor."""
    rows = _sensor_rows(case, extremes)
    lines = text_table(HEADER, rows[:MAX_SENSORS], "<><>>>>", "  ") if rows else []
    others = (f"  {line}" for line in _left_out(rows))
    return "\n".join([_head(case, times), f"  {verdict}", *lines, *others])


def record_html(case: Case, times, verdict: str, extremes: Extremes) -> str:
    """`record_text` as a table in HTML with a paragraph below it."""
    rows = _sensor_rows(case, extremes)
    table = html_table(HEADER, rows[:MAX_SENSORS], _head(case, times))
    return f"{table}<p>{escape('; '.join([verdict, *_left_out(rows)]))}</p>"


def _head(case: Case, times) -> str:
    times = np.asarray(times)
    parts = [f"{times.size} samples to {times[-1]:.4g} s"]
    for count, word in ((len(case.sensors), "sensor"), (len(case.loads), "load")):
        parts.append(f"{count} {word}{'s' * (count != 1)}")
    head = f"Record of {case.title!r}" if case.title else "Record"
    return f"{head}: {', '.join(parts)}"


def _left_out(rows: list) -> list[str]:
    return [f"... {len(rows) - MAX_SENSORS} more sensors"] if len(rows) > MAX_SENSORS else []


def _sensor_rows(case: Case, extremes: Extremes) -> list[tuple[str, ...]]:
    """Rows of a table: smallest and largest value of each sensor, signed, with their times."""
    rows = []
    columns = zip(case.sensors, sensor_labels(case.sensors), *extremes, strict=True)
    for sensor, label, low, low_time, high, high_time in columns:
        side = f" {sensor.side}" if sensor.side else ""
        position, unit = f"{float(sensor.position):.4g} m{side}", sensor.unit
        name = sensor.name or label.partition(":")[0]
        row = (name, position, sensor.quantity, with_prefix(float(low), unit))
        row += (f"{low_time:.4g} s", with_prefix(float(high), unit), f"{high_time:.4g} s")
        rows.append(row)
    return rows


class RecordViews(TableViews, Module):
    """Base of records: their text, tables, datasets, figures and files."""

    case: eqx.AbstractVar[Case]
    modes: eqx.AbstractVar[Modes]
    times: eqx.AbstractVar[Float[Array, " time"]]
    coordinates: eqx.AbstractVar[Float[Array, "time mode"]]
    contact_force: eqx.AbstractVar[Float[Array, "time load"]]
    command: eqx.AbstractVar[Float[Array, "time actuator"]]

    @property
    @abc.abstractmethod
    def bodies(self) -> list[str]:
        """Names of the degrees of freedom of all vehicles."""

    @property
    @abc.abstractmethod
    def verdict(self) -> str:
        """Sentence on the run."""

    @property
    @abc.abstractmethod
    def extremes(self) -> Extremes:
        """Smallest and largest value of each sensor."""

    @property
    @abc.abstractmethod
    def sensor_values(self) -> Float[Array, "time sensor"]:
        """True quantity of each sensor."""

    def __repr__(self) -> str:
        if not self._is_one_concrete_run:
            return f"Record of {self.case.title!r}, traced or of several runs"
        return record_text(self.case, self.times, self.verdict, self.extremes)

    def _repr_html_(self) -> str | None:  # in notebooks; None leaves it to the text
        if not self._is_one_concrete_run:
            return None
        return record_html(self.case, self.times, self.verdict, self.extremes)

    @property
    def _is_one_concrete_run(self) -> bool:
        return not any_traced(self) and self.times.ndim == 1

    def _dataset_parts(self) -> tuple[dict, dict, dict]:
        """Variables, coordinates and attributes of the labelled dataset."""
        return dataset_parts(
            self.case, self.modes, self.times, self.bodies, lambda name: getattr(self, name)
        )

    @refuses_traced("a dataset")
    def to_xarray(self) -> "xarray.Dataset":
        """Labelled dataset with units; `record_from_xarray` restores the record exactly."""
        return labelled_dataset(*self._dataset_parts())

    def plot(self, quantity: str | None = None, **options: Any) -> "Figure | SubFigure":
        """Figure of the record, or of one quantity of its sensors; see `jaxbeam.plot.plot_record`.

        `options` are its `ax`, `title` and `labels`; it raises as that function does.
        """
        from jaxbeam.plot import plot_record

        return plot_record(self, quantity, **options)

    def plot_envelope(self, quantity: str = "moment", **options: Any) -> "Figure | SubFigure":
        """Figure of the envelope of a quantity; see `jaxbeam.plot.plot_envelope`."""
        from jaxbeam.plot import plot_envelope

        return plot_envelope(self, quantity, **options)

    @property
    @refuses_traced("a table")
    def columns(self) -> dict[str, Float[ndarray, " time"]]:
        """Histories by head, as "midspan deflection (m)"; `to_dataframe` has them too."""
        histories = self.sensor_values, self.contact_force, self.command
        return record_columns(self.case, self.times, *histories)

    def save(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write all of the record to .nc or .zarr, or its `columns` to .csv, .xlsx, .mat, .parquet.

        Raises FileExistsError if the file exists, without `overwrite`; ValueError for another
        ending; ImportError, with what to install, if a package is missing (see `jaxbeam.save`).
        """
        check_ending(path, "a record")
        if os.fspath(path).endswith(".nc"):  # without xarray, which takes long to import
            self.to_netcdf(path, overwrite)
        else:
            write_result(path, lambda: self.columns, self.to_xarray, overwrite)

    def to_html(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write an interactive figure of the histories, a page in one file, for any browser.

        Raises ValueError for another ending than .html, FileExistsError if the file exists,
        without `overwrite`.
        """
        check_ending(path, "an interactive figure", (".html",))
        page = interactive_page(_head(self.case, self.times), self.verdict, self.columns)
        with whole_file(path, overwrite) as partial:
            partial.write_text(page, encoding="utf-8")

    def to_netcdf(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write the labelled dataset to a netCDF file.

        Raises FileExistsError if the file exists, without `overwrite`.
        """
        with whole_file(path, overwrite) as partial:
            write_netcdf(partial, *self._dataset_parts())
