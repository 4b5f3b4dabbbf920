"""Sweeps, fits, comparisons and tunings of the page, whose partial results are shown at work."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxbeam as jb
from jaxbeam.case.case import Case, own_addresses, unit_at
from jaxbeam.case.fields import concrete
from jaxbeam.case.toml_file import number_in_si
from jaxbeam.files.tables import sweep_columns
from jaxbeam.runtime.progress import following

MAX_SWEPT = 10_000  # runs of a map on the screen
MAX_SHOWN = 1500  # samples of a log or a fit on the screen
LOG_ENDINGS = (".csv", ".txt", ".tsv", ".dat", ".mat", ".npz", ".h5", ".hdf5", ".tdms", ".uff")
LOG_ENDINGS += (".unv", ".parquet", ".lvm", ".nc", ".xlsx", ".toml")


def axis_values(case: Case, axis: Mapping[str, Any]) -> list[Any]:
    """Values of an axis of a sweep: words, or equidistant numbers of a range, also with units.

    Raises ValueError for an axis without two values and for numbers that cannot be read.
    """
    address = str(axis["address"])
    if "words" in axis:
        words = [word.strip() for word in axis["words"].split(",") if word.strip()]
        if not words:
            raise ValueError(f"{address} takes words, separated by commas")
        return words
    own_addresses(case, address)  # or else an error with the nearest
    unit = unit_at(case, address)
    low, high = (number_in_si(axis[end], unit, f"{address}: {end}") for end in ("from", "to"))
    count = int(axis["count"])
    if not 2 <= count <= MAX_SWEPT:
        raise ValueError(f"{address}: a sweep takes from 2 to {MAX_SWEPT} values, not {count}")
    return np.linspace(low, high, count).tolist()


class Sweep:
    """Sweep over one or two addresses, whose rows are shown as they are computed.

    The rows are those of the words, or else of the second address; `found` has the columns of the
    table (`jaxbeam.files.tables`) of each row so far.
    """

    def __init__(self, case: Case, axes: Sequence[Mapping[str, Any]]):
        if not 1 <= len(axes) <= 2:
            raise ValueError("a map is drawn over one or two addresses")
        values = {str(axis["address"]): axis_values(case, axis) for axis in axes}
        if len(values) < len(axes):
            raise ValueError("the two addresses of a map are the same")
        if np.prod([len(one) for one in values.values()]) > MAX_SWEPT:
            raise ValueError(f"a map on the screen has at most {MAX_SWEPT} runs: take fewer values")
        words = [address for address in values if isinstance(values[address][0], str)]
        names = list(values)
        self.rows = words[0] if words else names[-1] if len(names) > 1 else ""
        self.columns = next((name for name in names if name != self.rows), "")
        self.values, self.case = values, case
        self.found: list[dict[str, list[float]]] = []

    def run(self) -> None:
        """Compute all rows, one after the other. Raises as `jaxbeam.sweep`."""
        along = {self.columns: self.values[self.columns]} if self.columns else {}
        for value in self.values[self.rows] if self.rows else [None]:
            across = {} if value is None else {self.rows: [value]}
            table = sweep_columns(jb.sweep(self.case, along | across, progress=False))
            peaks = {
                head: np.asarray(column, float).tolist()
                for head, column in table.items()
                if (" peak " in head and not head.startswith("time of"))
                or "contact force" in head
                or head == "failed"
            }
            self.found.append(peaks)

    def state(self, known: int, name: str) -> dict[str, Any]:
        """Axes, rows from index `known` on, and Python and command of the sweep for a file."""
        unit = {
            a: "" if isinstance(v[0], str) else unit_at(self.case, a)
            for a, v in self.values.items()
        }
        return {
            "rows": self.rows,
            "columns": self.columns,
            "values": self.values,
            "units": unit,
            "found": self.found[known:],
            "words": self.words(name),
        }

    def words(self, name: str) -> dict[str, str]:
        """Texts of the same sweep in Python and as a command, for a case in a file of a name."""
        python, command = [], []
        for address, values in self.values.items():
            if isinstance(values[0], str):
                python.append(f"{address!r}: {values!r}")
                command.append(f"--over {address}={','.join(values)}")
            else:
                low, high, count = values[0], values[-1], len(values)
                python.append(f"{address!r}: np.linspace({low!r}, {high!r}, {count})")
                command.append(f"--over {address}={low!r}:{high!r}:{count}")
        return {
            "python": "import jaxbeam as jb\nimport numpy as np\n\n"
            f"runs = jb.sweep(jb.load_case({name!r}), {{{', '.join(python)}}})",
            "command": f"jaxbeam sweep {name} {' '.join(command)} --plot",
        }


def keep_log(folder: Path, name: str, content: bytes) -> Path:
    """Path of an uploaded log, or its description, stored under its name in a folder of its own.

    Raises ValueError for a name that no log has.
    """
    plain = re.fullmatch(r"[^./\\\0][^/\\\0]{0,200}", name) is not None
    if not plain or not name.lower().endswith(LOG_ENDINGS):
        raise ValueError(f"{name!r} is no log: it should end with {', '.join(LOG_ENDINGS)}")
    path = folder / name
    path.write_bytes(content)
    return path


def read_logs(path: Path, options: Mapping[str, Any]) -> list[Any]:
    """Logs of a file, read with options of `tuning.read_logs`. Raises ValueError as that does."""
    import warnings

    import tuning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they are among the faults of the log
        logs = tuning.read_logs(path, **options)
    folder = f"{path.parent}/"  # of the server: not shown on the page
    return [dataclasses.replace(log, source=log.source.removeprefix(folder)) for log in logs]


def describe_log(log: Any) -> dict[str, Any]:
    """Columns of a log with their units as read, its faults in words, and its samples."""
    import tuning

    chosen = _spread(log.times.size)
    return {
        "source": log.source,
        "duration": log.duration,
        "rate": log.sample_rate,
        "channels": [
            {"name": name, "quantity": quantity, "unit": unit}
            for name, quantity, unit in zip(log.names, log.quantities, log.units, strict=True)
        ],
        "loads": None if log.loads is None else [load.kind for load in log.loads],
        "faults": [str(fault) for fault in tuning.logs.find_faults(log)],
        "notes": list(log.notes),
        "times": log.times[chosen],
        "values": log.values[chosen].T,
    }


def _spread(count: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, MAX_SHOWN)).round().astype(int))


class PageFit:
    """Fit of free numbers of a case, each with bounds (also with units) or None, to logs.

    Each point of its search is shown: numbers, misfit, and predicted beside measured readings.
    """

    def __init__(self, case: Case, logs: Sequence[Any], free: Mapping[str, Any]):
        self.case, self.logs, self.misfits, self.point = case, logs, [], None
        loaded = case if logs[0].loads is None else dataclasses.replace(case, loads=logs[0].loads)
        self.bounds: dict[str, Any] = {}
        for address, pair in free.items():
            if pair is not None:
                unit = unit_at(loaded, re.sub(r"^logs\.[^.]+\.", "", address))
                pair = tuple(number_in_si(end, unit, address) for end in pair)
            self.bounds[address] = pair

    def run(self) -> dict[str, Any]:
        """Values with intervals, remarks on unobservable numbers, and fitted readings."""
        import tuning

        with following(self._see):
            found = tuning.identify(self.case, self.logs, self.bounds, progress=False)
        return found.to_dict() | {
            "remarks": found.remarks,
            "noise": np.asarray(found.noise),
            **self._readings(found.dataset, found.fitted),
        }

    def _see(self, point: Any) -> None:
        self.misfits.append(point.misfit)
        self.point = point

    def state(self, known: int, name: str) -> dict[str, Any]:
        """Misfits so far; numbers and readings of the last point if there are more than `known`."""
        point = self.point
        if point is None or len(self.misfits) == known:
            return {"misfits": self.misfits}
        addresses = [parameter.address for parameter in point.problem.parameters]
        return {
            "misfits": self.misfits,
            "numbers": dict(zip(addresses, point.values, strict=True)),
            **self._readings(point.problem.data, point.predicted),
        }

    def _readings(self, data: Any, predicted: np.ndarray) -> dict[str, Any]:
        """Measured and predicted readings of each log, with names and units of channels."""
        from jaxbeam.case.sensors import sensor_labels

        runs = []
        for i, log in enumerate(data.logs):
            chosen = _spread(log.times.size)
            mask = data.mask[i][chosen] > 0
            runs.append(
                {
                    "source": log.source,
                    "times": log.times[chosen],
                    "measured": np.where(mask, data.measured[i][chosen], np.nan).T,
                    "fitted": np.where(mask, predicted[i][chosen], np.nan).T,
                }
            )
        case = self.case
        labels = sensor_labels(case.sensors)
        labels = [*labels, *(f"vehicle {one.quantity}" for one in case.vehicle_sensors)]
        channels = [
            {"name": label, "quantity": one.quantity, "unit": one.unit}
            for label, one in zip(labels, case.all_sensors, strict=True)
        ]
        return {"runs": runs, "channels": channels}


def modes(
    logs: Sequence[Any], band: Sequence[float] | None, choose: Sequence[float]
) -> dict[str, Any]:
    """Modes of logs with their shapes, and the stabilisation diagram from which they are chosen.

    The `band` (Hz) is found if it is left out; of frequencies to `choose` (Hz) the nearest modes
    are kept, and no others.
    """
    import tuning
    from tuning.modal.plot import amplitude_spectrum, strongest_channel

    settings = tuning.ModalSettings(choose=tuple(map(float, choose)))
    within = None if band is None else (float(band[0]), float(band[1]))
    found = tuning.identify_modes(list(logs), band=within, settings=settings)
    channel = strongest_channel(found)
    frequencies, amplitudes = amplitude_spectrum(found, channel)
    pieces = np.array_split(np.arange(frequencies.size), min(frequencies.size, MAX_SHOWN // 2))
    highest = [piece[np.argmax(amplitudes[piece])] for piece in pieces]
    poles = [
        {"frequency": diagram.poles.frequencies[i], "order": diagram.poles.orders[i]}
        for diagram in found.diagrams
        for i in np.flatnonzero(diagram.stable)
    ]
    return {
        "modes": [mode.to_dict() for mode in found.modes],
        "rejected": [one.to_dict() | {"reason": reason} for one, reason in found.rejected],
        "summary": str(found),
        "window": found.window,
        "band": found.band,
        "poles": poles,
        "spectrum": {
            "channel": found.log.names[channel],
            "unit": found.log.units[channel],
            "frequencies": frequencies[highest],
            "amplitudes": amplitudes[highest],
        },
        "channels": found.channels._asdict(),
    }


def compare(case: Case, controllers: Mapping[str, Any]) -> dict[str, Any]:
    """Metrics and runs of controllers, the run without control, and the least achievable peak.

    The headline says why where there is no least achievable peak.
    """
    from jaxbeam.analysis.compare import compare as compare_controllers

    found = compare_controllers(case, dict(controllers))
    records = {"without": found.uncontrolled, **found.records}
    if found.optimal is not None:
        records["bound"] = found.optimal
    rows = []
    for name, metrics in found.metrics.items():
        rows.append(
            {
                "name": name,
                "peak": metrics.peak,
                "share": metrics.share,
                "rms": metrics.rms,
                "after_exit": metrics.after_exit,
                "saturated": float(np.max(metrics.saturated, initial=0.0)),
                "remarks": found.loop_summary(name),
            }
        )
    runs = {}
    for name, record in records.items():
        chosen = _spread(record.times.size)
        worst = int(np.argmax(record.peak_deflection)) if len(case.sensors) else 0
        runs[name] = {
            "times": record.times[chosen],
            "deflection": record.deflection[chosen, worst],
            "command": record.command[chosen].T,
        }
    uncontrolled = float(np.max(found.uncontrolled.peak_deflection))
    return {
        "headline": found.headline,
        "rows": rows,
        "uncontrolled": uncontrolled,
        "bound": found.bound and found.bound.peak,
        "runs": runs,
        "unit": next((one.command_unit for one in case.driven), ""),
    }


class PageTuning:
    """Tuning of numbers of a controller or an absorber, each with bounds or None.

    The number at `vary` is changed by the fractions -`spread`, 0 and `spread` in training, by half
    of these in held-out runs. Objective and numbers are shown after each step.
    """

    def __init__(self, case: Case, free: Mapping[str, Any], vary: str, spread: float, steps: int):
        middle = float(concrete(jb.addresses(case)[vary]))
        at = [{vary: middle * (1 + part * spread)} for part in (-1.0, 0.0, 1.0, -0.5, 0.5)]
        self.case, self.training, self.held_out, self.steps = case, at[:3], at[3:], steps
        self.bounds = {
            address: None if pair is None else tuple(map(float, pair))
            for address, pair in free.items()
        }
        self._seen: dict[str, Any] = {}

    def run(self) -> dict[str, Any]:
        """Objective by step, best numbers, and the verdict on held-out runs."""
        import tuning

        runs = tuning.LoadCases(tuple(self.training), tuple(self.held_out))
        with following(self._see):
            found = tuning.tune(self.case, self.bounds, runs, steps=self.steps, progress=False)
        return found.to_dict() | {
            "history": found.history[:, 0],
            "verdict": found.verdict,
            "settings": self._settings(found.values),
        }

    def _see(self, found: Any) -> None:
        history, values = found
        self._seen = {"history": history[:, 0], "settings": self._settings(values)}

    def _settings(self, values: np.ndarray) -> dict[str, float]:
        return dict(zip(self.bounds, map(float, values), strict=True))

    def state(self, known: int, name: str) -> dict[str, Any]:
        """Objective of each step so far, and the best numbers."""
        return self._seen
