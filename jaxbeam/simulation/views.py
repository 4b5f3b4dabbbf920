"""Views of records: text, tables, labelled datasets, figures and files; labels of results."""

import abc
import json
import os
from collections.abc import Callable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case
from jaxbeam.case.display import with_prefix
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.case.sensors import sensor_labels
from jaxbeam.files.case_file import case_to_dict
from jaxbeam.files.netcdf import write_netcdf
from jaxbeam.files.report import interactive_page
from jaxbeam.files.tables import write_result
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modes import Modes
from jaxbeam.runtime.arrays import Array, Module, any_traced
from jaxbeam.runtime.output_file import check_ending, whole_file
from jaxbeam.runtime.printer import TableViews, counted, html_table, labelled_dataset, text_table
from jaxbeam.simulation.errors import Extremes

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure, SubFigure

    from jaxbeam.case.case import Case

MAX_LISTED = 4  # wheels in a sentence
ROUNDING = 1e-12  # of a given force


def wheel_labels(loads: LoadSet) -> np.ndarray:
    """Labels of all wheels: the number of the load, "0", or of one of its wheels, "0 wheel 2".

    Wheels of a load of several are counted from 1, front first, through all its vehicles. Absorbers
    come last, "absorber 0".
    """
    owners, labels = loads.load_of_wheel, []
    for wheel, load in enumerate(owners):
        is_only = owners.count(load) == 1
        label = f"{load}" if is_only else f"{load} wheel {wheel - owners.index(load) + 1}"
        absorber = load - len(loads.trajectories) + loads.absorbers
        labels.append(label if absorber < 0 else f"absorber {absorber}")
    return np.array(labels, dtype=str)


def contact_sentence(case: Case, loads: LoadSet, lost_times, lost_positions, lowest_forces) -> str:
    """Sentence on lost contact: when (s), where (m) and how hard (N) wheels would have to pull.

    Times are NaN for wheels that press on the beam throughout. The first of many wheels are listed.
    Prescribed forces may be negative: these pull because they were given so.
    """
    negative, prescribed = np.isfinite(lost_times), loads.prescribed
    rounding = ROUNDING * _given_forces(loads)
    lowest_forces = np.where(np.abs(lowest_forces) <= rounding, 0.0, lowest_forces)
    negative = negative & ~(prescribed & (lowest_forces == 0))
    lost = np.flatnonzero(negative & ~prescribed)
    pulling = np.flatnonzero(negative & prescribed)
    if pulling.size and not lost.size:
        i = int(pulling[np.argmin(lowest_forces[pulling])])
        more = f" and {counted(pulling.size - 1, 'other')}" if pulling.size > 1 else ""
        return (
            f"the prescribed force of load {wheel_labels(loads)[i]}{more} is negative at times,"
            f" down to {lowest_forces[i]:.4g} N, as given"
        )
    if not lost.size:
        return _pressing_sentence(case, loads, lowest_forces)
    labels = wheel_labels(loads)
    first = lost[np.argsort(lost_times[lost], kind="stable")][:MAX_LISTED]
    parts = [
        f"load {labels[i]} loses contact, first at t = {lost_times[i]:.4g} s,"
        f" x = {lost_positions[i]:.4g} m (smallest contact force {lowest_forces[i]:.4g} N)"
        for i in sorted(first)
    ]
    more = lost.size - first.size
    return "; ".join([*parts, f"{more} more wheels lose contact"] if more else parts)


class Flights(Module):
    """Flights of wheels over the beam, in the order in which they begin; see `OF_FLIGHTS`.

    A wheel that has not landed when the run ends has a landing time of NaN; one may land behind the
    beam. The impulse is that of an impact, zero on springs.
    """

    wheel: Int[np.ndarray, " flight"]
    lift_time: Float[np.ndarray, " flight"]
    lift_position: Float[np.ndarray, " flight"]
    landing_time: Float[np.ndarray, " flight"]
    landing_position: Float[np.ndarray, " flight"]
    approach_speed: Float[np.ndarray, " flight"]
    impulse: Float[np.ndarray, " flight"]
    gap: Float[np.ndarray, " flight"]


def flights_sentence(case: Case, loads: LoadSet, flights: Flights) -> str:
    """Sentence on the flights of wheels: when and where they lift and land, gap and impulse.

    The first flight of each of the first wheels, and how many more there are.
    """
    labels, length, parts = wheel_labels(loads), float(concrete(case.beam.length)), []
    wheels = list(dict.fromkeys(flights.wheel.tolist()))
    for wheel in wheels[:MAX_LISTED]:
        own = np.flatnonzero(flights.wheel == wheel)
        i, more = own[0], own.size - 1
        landing, place = flights.landing_time[i], flights.landing_position[i]
        if np.isnan(landing):
            lands = "has not landed when the run ends"
        else:
            where = "on the beam" if 0 <= place <= length else "beside the beam"
            hard = f" with an impulse of {flights.impulse[i]:.4g} N s" if flights.impulse[i] else ""
            lands = f"lands {where} at t = {landing:.4g} s, x = {place:.4g} m{hard}"
        again = f", and flies {more} times more" if more > 1 else ", and flies once more" * more
        parts.append(
            f"load {labels[wheel]} leaves at t = {flights.lift_time[i]:.4g} s,"
            f" x = {flights.lift_position[i]:.4g} m, flies up to {flights.gap[i]:.3g} m above the"
            f" beam and {lands}{again}"
        )
    more = len(wheels) - MAX_LISTED
    return "; ".join([*parts, f"{more} more wheels fly"] if more > 0 else parts)


def _given_forces(loads: LoadSet) -> Float[np.ndarray, " wheel"]:
    """Bounds (N) of the given forces of wheels: weights, waves and tables."""
    bounds = np.abs(concrete(loads.weight)[:, 0])
    for wheel, history in loads.wheels.histories.items():
        amplitudes, forces = concrete(history.amplitudes), concrete(history.forces)
        bounds[wheel] += np.sum(np.abs(amplitudes)) + np.max(np.abs(forces), initial=0.0)
    return bounds


def _pressing_sentence(case: Case, loads: LoadSet, lowest_forces) -> str:
    """Sentence on a run without lost contact: which wheels press on the beam throughout."""
    if not case.loads:
        return "the case has no loads"
    labels = wheel_labels(loads)
    enter, leave = concrete(loads.entry_exit_times()).T
    crosses = (enter < concrete(case.run.duration)) & (leave > 0) & ~loads.fixed
    if not np.any(crosses):
        return "no load is on the beam during the run"
    weightless = crosses & (concrete(loads.weight)[:, 0] == 0) & (lowest_forces == 0)
    weightless[list(loads.wheels.histories)] = False
    released = crosses & (lowest_forces == 0) & ~weightless
    exceptions = [
        (weightless, "{} has no weight", "{} have no weight"),
        (released, "the force of {} falls to 0 N", "the forces of {} fall to 0 N"),
        (~crosses & ~loads.fixed, "{} is not on the beam", "{} are not on the beam"),
    ]
    parts = []
    for wheels, one, several in exceptions:
        index = np.flatnonzero(wheels)
        if index.size:
            listed = ", ".join(labels[index[:MAX_LISTED]])
            more = f" and {index.size - MAX_LISTED} more" if index.size > MAX_LISTED else ""
            words, loads_of = (one, "load") if index.size == 1 else (several, "loads")
            parts.append(words.format(f"{loads_of} {listed}{more}"))
    if np.any(crosses & ~weightless & ~released):
        other = "other " if parts else ""
        parts.append(f"every {other}load presses on the beam throughout")
    return "; ".join(parts)


VARIABLES = {
    "deflection": (("time", "sensor"), "m", "deflection at the sensor"),
    "velocity": (("time", "sensor"), "m/s", "velocity at the sensor"),
    "acceleration": (("time", "sensor"), "m/s^2", "acceleration at the sensor"),
    "measured": (("time", "sensor"), "SI unit of its quantity", "reading of the sensor"),
    "coordinates": (("time", "mode"), "m kg^0.5", "modal coordinate"),
    "rates": (("time", "mode"), "m kg^0.5/s", "rate of the modal coordinate"),
    "accelerations": (("time", "mode"), "m kg^0.5/s^2", "acceleration of the modal coordinate"),
    "load_position": (("time", "load"), "m", "position of the wheel"),
    "contact_force": (("time", "load"), "N", "contact force, positive under compression"),
    "command": (("time", "actuator"), "unit of a command", "command to the actuator"),
    "failures": (("time",), "1", "steps of the controller without a solution so far"),
    "smallest": (("sensor",), "SI unit of its quantity", "smallest value of its quantity"),
    "smallest_time": (("sensor",), "s", "time of the smallest value"),
    "largest": (("sensor",), "SI unit of its quantity", "largest value of its quantity"),
    "largest_time": (("sensor",), "s", "time of the largest value"),
    "peak_deflection": (("sensor",), "m", "largest absolute deflection at the sensor"),
    "peak_time": (("sensor",), "s", "time of the largest absolute deflection at the sensor"),
    "step_errors": (("sensor",), "1", "estimated error of the time steps, of the largest value"),
    "lowest_contact_force": (("load",), "N", "smallest contact force"),
    "contact_lost_time": (("load",), "s", "time of the first negative contact force"),
    "contact_lost_position": (("load",), "m", "position of the first negative contact force"),
    "body_displacement": (("time", "body"), "m or rad", "displacement from static equilibrium"),
    "body_velocity": (("time", "body"), "m/s or rad/s", "velocity of the body"),
    "body_acceleration": (("time", "body"), "m/s^2 or rad/s^2", "acceleration of the body"),
}
OF_ABSORBERS = {
    "stroke": (("time", "absorber"), "m", "motion of the absorber's body relative to the beam"),
    "absorber_force": (("time", "absorber"), "N", "force on the beam, positive downwards"),
    "absorber_energy": (("time", "absorber"), "J", "energy dissipated so far"),
    "peak_stroke": (("absorber",), "m", "largest absolute stroke of the absorber"),
    "peak_absorber_force": (("absorber",), "N", "largest absolute force of the absorber"),
}
# With unilateral contact; names in files begin with flight_.
OF_FLIGHTS = {
    "wheel": ("1", "index of the wheel that flies"),
    "lift_time": ("s", "time at which it leaves"),
    "lift_position": ("m", "position at which it leaves"),
    "landing_time": ("s", "time at which it lands"),
    "landing_position": ("m", "position at which it lands"),
    "approach_speed": ("m/s", "speed at which wheel and surface meet"),
    "impulse": ("N s", "impulse of the impact"),
    "gap": ("m", "largest height above the surface"),
}
# Where an actuator has a hysteresis or creep.
ACTING_COMMAND = (("time", "actuator"), "unit of a command", "command that acts on the beam")
# Variables of a run in a sweep; the dimensions of the sweep come first.
SWEEP_VARIABLES = VARIABLES | {
    **OF_ABSORBERS,
    "controller_failures": ((), "1", "steps at which the controller found no solution"),
}

# Variables of the modes in records, with names that begin with mode_.
MODE_VARIABLES = {
    "stiffness": (("mode",), "1/s^2", "stiffness of the mode"),
    "damping": (("mode",), "1/s", "damping of the mode"),
    "coupling": (("mode", "other_mode"), "1/s^2", "stiffness between repeated modes"),
    "damping_coupling": (("mode", "other_mode"), "1/s", "damping between repeated modes"),
    "nodes": (("node",), "m", "ends of the segments of the mode shapes"),
    "series": (("segment", "degree", "mode"), "kg^-0.5", "Chebyshev series of the mode shapes"),
    "unit": ((), "1/s^2", "flexural rigidity / (mass per length x length^4)"),
}
# Units and words of the series of the modes of beams that are flexible in shear, or twist.
FURTHER_SERIES = {
    "rotation_series": ("m^-1 kg^-0.5", "Chebyshev series of the rotations of the modes"),
    "twist_series": ("rad kg^-0.5", "Chebyshev series of the twists of the modes"),
}
# Fields of `Modes` by their names in files, where they differ.
MODE_FIELDS = {"unit": "stiffness_unit"}


def sensor_coordinates(case: Case) -> dict[str, tuple]:
    """Coordinates of datasets along their sensors: labels, quantities and their units."""
    sensors = case.sensors
    return {
        "sensor": ("sensor", np.array(sensor_labels(sensors), str)),
        "quantity": ("sensor", np.array([s.quantity for s in sensors], str)),
        "unit": ("sensor", np.array([s.unit for s in sensors], str)),
    }


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
    parts = [f"{counted(times.size, 'sample')} to {times[-1]:.4g} s"]
    parts += [counted(len(case.sensors), "sensor"), counted(len(case.loads), "load")]
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

    @checks_classes
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

    @checks_classes
    def to_html(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write an interactive figure of the histories, a page in one file, for any browser.

        Raises ValueError for another ending than .html, FileExistsError if the file exists,
        without `overwrite`.
        """
        check_ending(path, "an interactive figure", (".html",))
        page = interactive_page(_head(self.case, self.times), self.verdict, self.columns)
        with whole_file(path, overwrite) as partial:
            partial.write_text(page, encoding="utf-8")

    @checks_classes
    def to_netcdf(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write the labelled dataset to a netCDF file.

        Raises FileExistsError if the file exists, without `overwrite`.
        """
        with whole_file(path, overwrite) as partial:
            write_netcdf(partial, *self._dataset_parts())
