"""What an application needs: cases from text, errors and results as data, work it may cancel.

The command line is made of these. All values are of JSON types once `plain` has seen them.
"""

import contextvars
import dataclasses
import os
import re
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxbeam.case.case import Case, part_classes
from jaxbeam.case.fields import refuses_traced
from jaxbeam.case.sensors import sensor_labels
from jaxbeam.case.toml_file import parse_toml
from jaxbeam.files.case_file import case_from_tables, load_case_with
from jaxbeam.model.plausibility.check import leave_warnings_to_caller
from jaxbeam.model.plausibility.facts import Plausibility
from jaxbeam.runtime.progress import watching
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.views import OF_FLIGHTS

if TYPE_CHECKING:
    import xarray

    from jaxbeam.analysis.ride import RideMeasures

__all__ = ["load_case", "problem", "plain", "content", "Job"]

MIN_RIDE_RATE = 160.0  # Hz, twice the highest frequency of the weighting of ride measures


def load_case(
    source: str | os.PathLike | Mapping[str, Any],
    settings: Mapping[str, Any] = MappingProxyType({}),
    folder: str | os.PathLike = ".",
) -> Case:
    """The validated case of a source: a file (a path), the text of one, or its tables.

    `settings` are other values at some addresses, numbers in SI units, texts with units or words.
    Files that a text or tables name, as those of profiles, must be below the `folder`. Unlike
    `jaxbeam.load_case` it does not warn: ask `jaxbeam.check`.

    Raises ValueError for whatever is wrong (see `problem`), OSError if a file cannot be read.

    >>> text = '''[beam]
    ... length = "25 m"
    ... flexural_rigidity = 3e10
    ... mass_per_length = 15e3
    ... '''
    >>> print(load_case(text, {"beam.length": "30 m"}).beam.length)
    30.0
    """
    if isinstance(source, os.PathLike):
        return load_case_with(source, settings)
    content = parse_toml(source) if isinstance(source, str) else source
    return case_from_tables(content, Path(folder), settings)


class Problem(NamedTuple):
    """What is wrong with an input: the sentence, and where, as far as it says so.

    `address` is that of an entry of the case, such as loads.0.speed, `line` one of its text.
    """

    message: str
    address: str | None = None
    line: int | None = None


def problem(error: Exception) -> Problem:
    """An `error` as data.

    >>> try:
    ...     load_case({"beam": {"length": -1.0, "flexural_rigidity": 1.0, "mass_per_length": 1.0}})
    ... except ValueError as error:
    ...     print(problem(error).address)
    beam.length
    """
    message = " ".join(str(error).split())
    key = "|".join(("title", *part_classes()))
    entry = rf"(?<![\w.])(?:{key})(?:\.(?:\w+|\*))+"
    # A part alone is a word of other sentences, too, but for one that begins with it.
    found = re.search(rf"(?:^|: )({entry}|(?:{key})\b)(?=[ :])", message) or re.search(
        rf"({entry})", message
    )
    unknown = re.search(r" has no key '(\w+)'", message)
    address = found and found[1] + (f".{unknown[1]}" if unknown else "")
    line = re.search(r"\(at line (\d+)", message)
    return Problem(message, address, int(line[1]) if line else None)


@refuses_traced("plain data")
def plain(value: Any) -> Any:
    """A value of JSON types: arrays as lists, keys as strings, None for infinite and NaN.

    Raises ValueError for traced numbers.

    >>> plain({"peaks": np.array([1.0, np.nan])})
    {'peaks': [1.0, None]}
    """
    return _plain(value)


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


@refuses_traced("plain data")
def content(result: "Record | Plausibility | xarray.Dataset") -> dict[str, Any]:
    """Numbers of a `result` by their names (SI units), those that the commands print with `--json`.

    Results are those of `simulate`, `check` and `sweep`; histories of a record are its `columns`.
    Raises ValueError for traced numbers.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> print(content(jb.simulate(case))["sensors"][0]["quantity"])
    deflection
    """
    if isinstance(result, Record):
        return _content_of_record(result)
    if isinstance(result, Plausibility):
        names = ("span_over_deflection", "speed_ratio")
        return dataclasses.asdict(result) | {name: getattr(result, name) for name in names}
    return _content_of_sweep(result)


def _content_of_record(record: Record) -> dict[str, Any]:
    from jaxbeam.analysis.ride import wheel_unloading
    from jaxbeam.analysis.sections import record_amplification

    sensors, controller = record.case.sensors, record.case.controller
    names, columns = zip(*record.extremes._asdict().items(), strict=True)
    unknown = np.full(len(sensors), np.nan)
    errors = {
        "dynamic_amplification": record_amplification(record),
        "step_error": record.step_errors,
        "truncation_error": record.truncation_errors if controller is None else unknown,
    }
    rows = zip(sensor_labels(sensors), sensors, *columns, *errors.values(), strict=True)
    listed = [
        {"name": label, "quantity": s.quantity, "unit": s.unit, "position": s.position}
        | dict(zip((*names, *errors), values, strict=True))
        for label, s, *values in rows
    ]
    peaks = zip(sensors, record.peak_deflection, strict=True)
    found: dict[str, Any] = {
        "sensors": listed,
        # None at sensors of other quantities.
        "peak_deflection": [peak if s.quantity == "deflection" else None for s, peak in peaks],
        "lowest_contact_force": record.lowest_contact_force,
        "largest_contact_force": record.contact_force.max(axis=0),
        "wheel_unloading": wheel_unloading(record),
        "contact_lost_time": record.contact_lost_time,
        "error_estimate": record.error_estimate,
        "steps": record.steps,
    }
    if record.flights is not None:
        found["flights"] = {name: getattr(record.flights, name) for name in OF_FLIGHTS}
    if record.case.absorbers:
        found["absorbers"] = {
            "position": [absorber.position for absorber in record.case.absorbers],
            "largest_stroke": record.peak_stroke,
            "largest_force": record.peak_absorber_force,
            "energy": record.absorber_energy[-1],
        }
    ride = ride_of(record)
    if ride is not None:
        found["ride"] = {
            "body": ride.bodies,
            "weighted_rms": ride.weighted_rms,
            "vibration_dose": ride.vibration_dose,
            "sperling_index": ride.sperling_index,
        }
    if controller is not None:
        found |= {
            "peak_command": record.peak_command,
            "effort": record.effort,
            "saturated": record.saturated.mean(axis=0),
        }
    return plain(found | {"verdict": record.verdict})


def ride_of(record: Record) -> "RideMeasures | None":
    """Ride measures of the bodies, None without any or with too few samples a second for them."""
    vehicles = len(record.bodies) > len(record.case.absorbers)
    if not vehicles or float(record.case.run.sample_rate) < MIN_RIDE_RATE:
        return None
    from jaxbeam.analysis.ride import ride_measures

    return ride_measures(record)


def _content_of_sweep(results: "xarray.Dataset") -> dict[str, Any]:
    swept = [name for name in results.coords if "." in str(name)]
    peaks = [name for name in results if str(name).startswith("peak_") and name != "peak_time"]
    return plain(
        {
            "values": {str(name): results[name].values for name in swept},
            "dimensions": results["peak_time"].dims,
            "failed_runs": int(results["failed"].sum()),
            "error_estimate": float(results.attrs["error_estimate"]),
        }
        | {str(name): results[name].values for name in peaks}
    )


class Cancelled(Exception):
    """Work that an application has cancelled."""


class Progress(NamedTuple):
    """Steps done and those of the whole, as far as the work counts them, and what a step is."""

    done: int = 0
    total: int = 0
    step: str = ""


class Job:
    """Work in a thread, whose progress is seen, and which may be cancelled.

    Sweeps, assessments and tunings count their runs or steps and end after the one in which they
    are cancelled; a store keeps finished blocks. Work that counts nothing ends when it is done.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> job = Job(jb.sweep, case, {"loads.0.speed": [1.0, 2.0]}, progress=False)
    >>> print(job.result().peak_deflection.shape, job.progress)
    (2, 1) Progress(done=2, total=2, step='run')
    """

    def __init__(self, work: Callable[..., Any], *arguments: Any, **options: Any):
        self.progress = Progress()
        self._result: Any = None
        self._error: BaseException | None = None
        self._cancelled = threading.Event()
        run = contextvars.Context().run  # settings of the caller's context are not the work's
        arguments = (self._run, work, arguments, options)
        self._thread = threading.Thread(target=run, args=arguments, daemon=True)
        self._thread.start()

    @property
    def done(self) -> bool:
        """Whether the work has ended, in whatever way."""
        return not self._thread.is_alive()

    def cancel(self) -> None:
        """Ask the work to end; `result` waits until it has, and raises Cancelled."""
        self._cancelled.set()

    def result(self, timeout: float | None = None) -> Any:
        """What the work returns, after at most a `timeout` in s.

        Raises TimeoutError if it still runs then, Cancelled if it was cancelled, and otherwise
        what the work raises.
        """
        self._thread.join(timeout)
        if not self.done:
            raise TimeoutError(f"still at work after {timeout:g} s")
        if self._error is not None:
            raise self._error
        return self._result

    def _run(self, work, arguments, options) -> None:
        leave_warnings_to_caller()
        try:
            with watching(self._on_step):
                result = work(*arguments, **options)
            self._on_step(*self.progress)
            self._result = result
        except BaseException as error:  # for who asks for the result
            self._error = error

    def _on_step(self, done: int, total: int, step: str) -> None:
        self.progress = Progress(done, total, step)
        if self._cancelled.is_set():
            raise Cancelled("cancelled")
