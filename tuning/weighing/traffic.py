"""Traffic over a bridge: a table of vehicles from long logs, each weighed once.

A bridge is loaded where a reading, smoothed over two cycles of the first mode, exceeds that of a
light vehicle, and the noise. The level of a sensor, which drifts with temperature, is the median of
a minute or more.
"""

import dataclasses
import datetime
import hashlib
import json
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import refuses_traced
from jaxbeam.runtime.input_file import read_text_input
from jaxbeam.runtime.interrupts import keeping
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.runtime.printer import TableViews, counted, text_table
from jaxbeam.runtime.progress import ProgressBar
from tuning.fit.dataset import sensor_readings
from tuning.logs.log import Log, LogWarning
from tuning.logs.readers.headings import epoch_seconds
from tuning.logs.reading import read_log, version_of
from tuning.modal.preprocessing import with_channels
from tuning.weighing.axle_fit import AxleFit, CrossingLog, interpolated, telling_sensors
from tuning.weighing.axles import MOST_EXCESS, with_free_frequency
from tuning.weighing.influence_lines import AxleGeometry, InfluenceLines, lines_for
from tuning.weighing.vehicles import (
    LEAST_GAP,
    axles_of_pulses,
    pulse_times,
    vehicles_in,
)

FORMAT = "jaxbeam vehicles 1"
LEAST_WEIGHT = 35e3  # N, of vehicles that are weighed: lorries, by the usual limit of 3.5 t
LEAST_READING = 0.25  # times the largest ordinate and this weight, of a vehicle of some axles
NOISE = 6.0  # times the deviation of a smoothed reading, above which something is on the bridge
# Shortest time of a median for the level of a sensor: s, and passages of the slowest vehicle.
LEVEL, PASSAGES = 60.0, 12.0
LONGEST = 20.0  # m, of a vehicle
AFTER = 2.0  # s of free vibration after a vehicle, from which its frequency is estimated
BEFORE = 0.6  # s of readings before a vehicle
LEAST_VALID = 0.5  # of the samples while something is on the bridge
MAX_LISTED = 20  # vehicles, in the text


@dataclasses.dataclass(frozen=True)
class TrafficSettings:
    """Settings of the search for vehicles in logs.

    `speeds` (m/s) are the lowest and highest ones, in both directions or, without `both_ways` and
    where the sensors do not tell directions, from the left only; vehicles lighter than the
    `least_weight` (N) may be passed over. `detectors` are the channels of two detectors of axles
    and their positions (m).

    Raises ValueError unless speeds are 0 < low < high, the least weight is a positive number, and
    detectors are none, or two at two positions.

    >>> TrafficSettings((8.0, 35.0)).least_weight
    35000.0
    """

    speeds: tuple[float, float]
    both_ways: bool = True
    least_weight: float = LEAST_WEIGHT
    detectors: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        low, high = self.speeds
        if not 0 < low < high:
            raise ValueError(f"speeds must be 0 < low < high in m/s; they are {low:g} and {high:g}")
        if not 0 < self.least_weight < np.inf:
            raise ValueError(
                f"the least weight must be a positive number of N, not {self.least_weight:g}"
            )
        places = list(self.detectors.values())
        if places and not (len(set(places)) == len(places) == 2 and np.isfinite(places).all()):
            listed = ", ".join(f"{name} at {place:g} m" for name, place in self.detectors.items())
            raise ValueError(
                "there must be two detectors of axles at two positions, or none; given are"
                f" {listed}: a speed is their distance over the time between them"
            )


class WeighedVehicle(NamedTuple):
    """Vehicle weighed: speed, axles, forces (SI units), and half widths of their 95 % intervals.

    `time` (s) is that at which the first axle enters the bridge, in the log of the name `file`;
    `stamp` its date and time, "" if the log has none. A negative speed is from right to left.
    `doubt` is a sentence on why the weights may be wrong, "" if there is none.

    >>> loads, errors = [6e4, 9e4], [1e3, 2e3]
    >>> one = WeighedVehicle("log", 1.0, "", 20.0, [0, 4], loads, errors, 1.5e5, 2e3, [1, 1])
    >>> one.silhouette
    '1-1'
    """

    file: str
    time: float
    stamp: str
    speed: float
    offsets: list[float]
    forces: list[float]
    force_half_widths: list[float]
    gross_weight: float
    gross_half_width: float
    groups: list[int]
    doubt: str = ""

    @property
    def silhouette(self) -> str:
        """Class of the vehicle: numbers of axles in its groups from the front, as "1-1-3"."""
        return "-".join(map(str, self.groups))


@dataclasses.dataclass(frozen=True)
class WeighedTraffic(TableViews):
    """Vehicles in the order of time, and sentences on parts of logs that were not weighed.

    >>> print(WeighedTraffic(()).verdict)
    no vehicle is found
    """

    vehicles: tuple[WeighedVehicle, ...]
    problems: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """Sentence on the number, directions and weights of the vehicles."""
        count = len(self.vehicles)
        if not count:
            return "no vehicle is found"
        weights = np.array([one.gross_weight for one in self.vehicles]) / 1e3
        right = sum(one.speed > 0 for one in self.vehicles)
        doubted = sum(bool(one.doubt) for one in self.vehicles)
        return (
            f"{counted(count, 'vehicle')}, {right} from the left and {count - right} from"
            f" the right, of {weights.min():.4g} to {weights.max():.4g} kN"
            + f"; {doubted} with a doubt"
            * bool(doubted)
        )

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Columns by head, a row for each vehicle; NaN for axles that it does not have."""
        rows = self.vehicles
        most = max((len(one.forces) for one in rows), default=0)

        def axles(name, scale):
            table = np.full((len(rows), most), np.nan)
            for row, one in zip(table, rows, strict=True):
                row[: len(one.forces)] = np.array(getattr(one, name)) * scale
            return table.T

        low, high = (
            np.array([1e-3 * (one.gross_weight + sign * one.gross_half_width) for one in rows])
            for sign in (-1, 1)
        )
        found = {
            "log": np.array([one.file for one in rows], str),
            "time (s)": np.array([one.time for one in rows], float),
            "date and time": np.array([one.stamp for one in rows], str),
            "direction": np.array(["right" if one.speed > 0 else "left" for one in rows], str),
            "speed (m/s)": np.array([abs(one.speed) for one in rows], float),
            "axles": np.array([len(one.forces) for one in rows], int),
            "class": np.array([one.silhouette for one in rows], str),
            "gross weight (kN)": np.array([1e-3 * one.gross_weight for one in rows], float),
            "gross weight, low (kN)": low,
            "gross weight, high (kN)": high,
        }
        forces, halves = axles("forces", 1e-3), axles("force_half_widths", 1e-3)
        for i, (force, half) in enumerate(zip(forces, halves, strict=True), 1):
            found[f"axle {i} (kN)"] = force
            found[f"axle {i}, low (kN)"], found[f"axle {i}, high (kN)"] = force - half, force + half
        for i, place in enumerate(axles("offsets", 1.0)[1:], 2):
            found[f"axle {i} at (m)"] = place
        return found | {"doubt": np.array([one.doubt for one in rows], str)}

    def to_dict(self) -> dict[str, Any]:
        """Vehicles and problems, plain numbers for JSON (SI units)."""
        vehicles = [one._asdict() | {"class": one.silhouette} for one in self.vehicles]
        return {"verdict": self.verdict, "vehicles": vehicles, "problems": list(self.problems)}

    def __str__(self) -> str:
        head = ("time", "to", "m/s", "class", "gross (kN)", "95 % interval", "axles (kN)")
        rows = [
            (
                one.stamp or f"{one.time:.2f} s", "right" if one.speed > 0 else "left",
                f"{abs(one.speed):.1f}", one.silhouette, f"{one.gross_weight / 1e3:.4g}",
                f"{(one.gross_weight - one.gross_half_width) / 1e3:.4g} to"
                f" {(one.gross_weight + one.gross_half_width) / 1e3:.4g}",
                " ".join(f"{force / 1e3:.3g}" for force in one.forces) + " (?)" * bool(one.doubt),
            )
            for one in self.vehicles[:MAX_LISTED]
        ]  # fmt: skip
        lines = [self.verdict, *(text_table(head, rows, "<<><>><") if rows else [])]
        more = len(self.vehicles) - MAX_LISTED
        lines += [f"and {more} more: write the table with -o vehicles.csv"] * (more > 0)
        return "\n".join([*lines, *self.problems])


class Passing(NamedTuple):
    """Start and end (s) of a part of a log with a loaded bridge; why it cannot be weighed."""

    start: float
    end: float
    problem: str = ""


def passings(
    lines: InfluenceLines,
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
    settings: TrafficSettings,
) -> list[Passing]:
    """Parts of readings in which the bridge is loaded, in the order of time.

    `lines` are the influence lines of the sensors, `times` (s) those of the `readings` (SI units).

    >>> import numpy as np
    >>> lines = InfluenceLines(np.array([0.0, 5, 10]), np.array([[0.0], [-1e-8], [0]]))
    >>> times = np.arange(2000) / 100
    >>> readings = 5e4 * lines.at(20 * (times - 9.0))
    >>> found = passings(lines, times, readings, TrafficSettings((10.0, 30.0)))
    >>> print([(round(one.start, 1), round(one.end, 1)) for one in found])
    [(8.5, 11.4)]
    """
    low, high = settings.speeds
    step = float(np.median(np.diff(times)))
    span = max(LEVEL, PASSAGES * (lines.length + LONGEST) / low)
    blocks = np.array_split(np.arange(times.size), max(int((times[-1] - times[0]) / span), 1))
    middles = [float(times[own].mean()) for own in blocks]
    cycle = max(round(1 / (lines.frequency * step)), 1) if lines.frequency else 1
    twice = np.convolve(np.ones(cycle), np.ones(cycle)) / cycle**2
    on = np.zeros(times.size, bool)
    for reading, line in zip(readings.T, lines.values.T, strict=True):
        medians = [float(np.median(reading[own])) for own in blocks]
        level = reading - np.interp(times, middles, medians)
        smooth = np.convolve(level, twice, "same") if 2 * cycle < level.size else level
        noise = 1.4826 * float(np.median(np.abs(smooth)))
        least = LEAST_READING * settings.least_weight * float(np.abs(line).max())
        on |= np.abs(smooth) > max(least, NOISE * noise)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]])))
    spans = times[edges.reshape(-1, 2) - [0, 1]]
    joined: list[list[float]] = []
    for first, last in spans.tolist():
        if joined and first - joined[-1][1] < lines.length / high:
            joined[-1][1] = last
        else:
            joined.append([first, last])
    gaps = times[:-1][np.diff(times) > 1.5 * step]
    found = []
    for i, (first, last) in enumerate(joined):
        before = joined[i - 1][1] if i else float(times[0])
        after = joined[i + 1][0] if i + 1 < len(joined) else float(times[-1])
        begin, end = max(first - BEFORE, (first + before) / 2), min(last + AFTER, after)
        if first - times[0] < 2 * step or times[-1] - last < 2 * step:
            problem = "the log begins or ends while it is on the bridge"
        elif np.any((gaps > begin) & (gaps < end)):
            problem = "samples are missing while it is on the bridge"
        else:
            problem = ""
        found.append(Passing(begin, end, problem))
    return found


ONE_SIGNED = 0.5  # of the area of a line's values without signs, that its area is at least
AT_ENDS = 0.3  # s at the start and end of a passing, between which its level is a straight line


def turned_sensors(
    lines: InfluenceLines,
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
    found: Sequence[Passing],
) -> list[int]:
    """Sensors that read with the sign opposite to their influence lines in most passings `found`.

    The integral of a reading over a passing is the weight times the area of the line over the
    speed, where the line has mostly one sign.

    >>> import numpy as np
    >>> lines = InfluenceLines(np.array([0.0, 5, 10]), np.array([[0.0], [-1e-8], [0]]))
    >>> times = np.arange(400) / 100
    >>> readings = -5e4 * lines.at(20 * (times - 1.0))
    >>> turned_sensors(lines, times, readings, [Passing(0.5, 3.5)])
    [0]
    """
    areas, sizes = lines.values.sum(axis=0), np.abs(lines.values).sum(axis=0)
    votes = np.zeros(areas.size)
    for one in found:
        own = readings[(times >= one.start) & (times <= one.end)]
        few = max(round(AT_ENDS / float(np.median(np.diff(times)))), 1)
        if one.problem or len(own) < 2 * few:
            continue
        level = np.linspace(own[:few].mean(axis=0), own[-few:].mean(axis=0), len(own))
        votes += np.sign((own - level).sum(axis=0))
    told = np.abs(areas) > ONE_SIGNED * sizes
    return np.flatnonzero(told & (votes * np.sign(areas) < 0)).tolist()


@refuses_traced("a weighing")
def weigh_vehicles(
    case: Case,
    log: Log,
    settings: TrafficSettings,
    influence_lines: InfluenceLines | None = None,
) -> WeighedTraffic:
    """Table of all vehicles that crossed the beam of a case in a log, alone or several at once.

    The `influence_lines` are by default those of the case (see `calibrate_influence_lines`). Loads
    and profile of case and log are not used.

    Raises ValueError if a sensor measures velocity or acceleration, the influence lines are of
    other sensors, and for a detector that the log does not have.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 8e9, 12e3, damping_ratio=0.02, modes=1),
    ...     sensors=[jb.Sensor(10.0, noise=2e-5)],
    ...     loads=[jb.MovingForce(force=1e5, speed=20.0, entry_time=2.0)],
    ...     run=jb.Run(6.0, sample_rate=50.0),
    ... )
    >>> record = jb.simulate(case)
    >>> columns = ("w",), ("deflection",), ("m",), "log", (0,)
    >>> log = tuning.Log(record.times, record.measured, *columns)
    >>> settings = tuning.weighing.TrafficSettings((10.0, 30.0))
    >>> (found,) = tuning.weighing.weigh_vehicles(case, log, settings).vehicles
    >>> print(f"{found.gross_weight / 1e3:.0f} kN, class {found.silhouette}")
    100 kN, class 1
    """
    lines = lines_for(case, influence_lines)
    settings, remarks = _with_directions(lines, settings)
    record = _Record.of(case, lines, log, settings)
    found = _traffic([record.weighed(one) for one in record.passings])
    return dataclasses.replace(found, problems=(*found.problems, *remarks))


@refuses_traced("a weighing")
def weigh_logs(
    case: Case,
    logs: Sequence[str | os.PathLike],
    store: str | os.PathLike,
    settings: TrafficSettings,
    influence_lines: InfluenceLines | None = None,
    *,
    columns: Sequence[str] | str | None = None,
    rate: float | None = None,
    missing: str = "refuse",
    progress: bool = False,
) -> WeighedTraffic:
    """Table of all vehicles in log files; those in the `store` are not weighed again.

    See `weigh_vehicles`, also for `influence_lines`. A line is added to the store, a text file,
    after each vehicle; logs that have changed, or whose descriptions have, are weighed again.
    `columns`, `rate` (Hz) and `missing` are those of `tuning.read_log`; a bar shows `progress`.
    Logs that cannot be read, and copies of others, are among the problems. Vehicles are in the
    order of their dates, or else of the logs.

    Raises FileNotFoundError without the folder of the store, ValueError for a store of another
    case, lines, settings or reading, if no log can be read, and as `weigh_vehicles` does.

    >>> import dataclasses
    >>> from pathlib import Path
    >>> import jaxbeam as jb
    >>> import tuning
    >>> beam, load = jb.Beam(20.0, 8e9, 12e3, 0.02), jb.MovingForce(force=1e5, speed=20.0)
    >>> load = dataclasses.replace(load, entry_time=2.0)
    >>> case = jb.Case(beam, sensors=[jb.Sensor(8.0)], loads=[load], run=jb.Run(6.0, 50.0))
    >>> record = jb.simulate(case)
    >>> rows = zip(record.times, record.deflection[:, 0])
    >>> text = "\\n".join(["t [s],w [m]", *(f"{t:.2f},{w:.4e}" for t, w in rows)])
    >>> _ = Path("monday.csv").write_text(text)
    >>> settings = tuning.weighing.TrafficSettings((10.0, 30.0))
    >>> found = tuning.weighing.weigh_logs(case, ["monday.csv"], "vehicles.jsonl", settings)
    >>> print(found.verdict)
    1 vehicle, 1 from the left and 0 from the right, of 100 to 100 kN
    """
    store, lines = Path(store), lines_for(case, influence_lines)
    if not store.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {store.parent} to write {store.name} to")
    reading: dict[str, Any] = {"columns": columns, "rate": rate, "missing": missing}
    stored = _Store.opened(store, _mark_of(case, lines, settings, reading))
    settings, remarks = _with_directions(lines, settings)
    paths, names, problems = [Path(path) for path in logs], [], []
    kept = keeping(lambda: f"{len(stored.found)} passings are in {store}: go on by the same")
    with kept, ProgressBar(len(paths), "log", shown=progress) as bar:
        for path in paths:
            name = f"{path.name} {version_of(path)}"
            names.append(name)
            if name not in stored.whole:
                try:
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore", LogWarning)
                        record = _Record.of(case, lines, read_log(path, **reading), settings)
                except (ValueError, OSError, ImportError) as error:
                    problems.append(" ".join(str(error).split()))
                    bar.update()
                    continue
                for number, one in enumerate(record.passings):
                    if f"{name} {number}" not in stored.found:
                        stored.add(f"{name} {number}", *record.weighed(one))
                stored.add(name, [], [], whole=len(record.passings))
            bar.update()
    if problems and len(problems) == len(paths):
        several = f"; none of the {len(paths)} logs can be weighed" * (len(paths) > 1)
        raise ValueError(problems[0] + several)
    parts, first_of = [], {}
    for name, path in zip(names, paths, strict=True):
        own = [stored.found[f"{name} {number}"] for number in range(stored.whole.get(name, 0))]
        rows = [one[1:] for vehicles, _ in own for one in vehicles]  # without the name of the log
        first = first_of.setdefault(repr(rows), path) if rows else path
        if first is path:
            parts += own
        else:
            problems.append(f"{path} is a copy of {first}: its vehicles count once")
    found = _traffic(parts)
    vehicles, dates = found.vehicles, [epoch_seconds(one.stamp) for one in found.vehicles]
    if all(dates):
        vehicles = tuple(vehicles[i] for i in np.argsort(dates, kind="stable"))
    return WeighedTraffic(vehicles, (*found.problems, *problems, *remarks))


SYMMETRY = 0.01  # of a line's largest value, by which it differs from its mirror image


def _with_directions(
    lines: InfluenceLines, settings: TrafficSettings
) -> tuple[TrafficSettings, list[str]]:
    """Settings with vehicles from the left alone if readings do not tell directions; why, if so."""
    mirrored = lines.at(lines.length - lines.positions)
    differences = np.abs(lines.values - mirrored).max(axis=0)
    told = np.any(differences > SYMMETRY * np.abs(lines.values).max(axis=0))
    if settings.detectors or not settings.both_ways or told:
        return settings, []
    return dataclasses.replace(settings, both_ways=False), [
        "the sensors read the same of vehicles from either end, all of which are listed as from the"
        " left: put a sensor off the middle of the beam, or give detectors"
    ]


class _Record(NamedTuple):
    """Log with the readings of its sensors and detectors, and its parts with a loaded bridge."""

    name: str
    start: str
    times: Float[np.ndarray, " time"]
    readings: Float[np.ndarray, "time sensor"]
    valid: Bool[np.ndarray, "time sensor"]
    signals: list[tuple[float, Float[np.ndarray, " time"]]]  # of detectors, with positions (m)
    lines: InfluenceLines
    settings: TrafficSettings
    passings: list[Passing]

    @classmethod
    def of(cls, case: Case, lines: InfluenceLines, log: Log, settings: TrafficSettings):
        """Record of a log. Raises ValueError for a detector that the log does not have."""
        signals, others = [], list(range(len(log.names)))
        for name, position in settings.detectors.items():
            if name not in log.names:
                raise ValueError(
                    f"{log.source}: there is no channel {name!r} for a detector of axles; its"
                    f" channels are {', '.join(log.names)}"
                )
            channel = log.names.index(name)
            signals.append((position, log.values[:, channel]))
            others.remove(channel)
        names = [log.names[i] for i in others]
        readings, valid = sensor_readings(case, with_channels(log, names) if signals else log)
        readings = interpolated(log.times, readings, valid)
        found = passings(lines, log.times, readings, settings)
        return cls(
            Path(log.source).name, log.start, log.times, readings, valid, signals, lines, settings,
            found,
        )  # fmt: skip

    def weighed(self, passing: Passing) -> tuple[list[WeighedVehicle], list[str]]:
        """Vehicles of a part of the log, and sentences on why it was not weighed.

        With the first part, sentences on sensors that read with the wrong sign.
        """
        vehicles, said = self._weighed(passing)
        turned = []
        if passing is self.passings[0]:
            turned = turned_sensors(self.lines, self.times, self.readings, self.passings)
        return vehicles, said + [
            f"{self.name}: sensors.{i} reads with the sign opposite to its influence line, and"
            " weights are wrong: turn its channel, or calibrate again"
            for i in turned
        ]

    def _weighed(self, passing: Passing) -> tuple[list[WeighedVehicle], list[str]]:
        """Vehicles of a part of the log, and sentences on why it was not weighed."""
        when = self._stamp(passing.start) or f"{passing.start:.2f} s"
        about = f"{self.name}, {when}: "
        if passing.problem:
            return [], [f"{about}{passing.problem}: not weighed"]
        own = (self.times >= passing.start) & (self.times <= passing.end)
        times, readings, valid = self.times[own], self.readings[own], self.valid[own]
        telling = telling_sensors(readings, valid)
        if valid.any(axis=1).mean() < LEAST_VALID or not telling.any():
            return [], [f"{about}samples are missing while it is on the bridge: not weighed"]
        settings, seen = self.settings, None
        if self.signals:
            apart = LEAST_GAP / settings.speeds[1]
            (first, one), (second, other) = self.signals
            pulses = pulse_times(times, one[own], apart), pulse_times(times, other[own], apart)
            seen = axles_of_pulses(pulses, (first, second), settings.speeds, self.lines.length)
            if not settings.both_ways:
                seen = [at for at in seen if at.speed > 0]
        readings, valid = readings[:, telling], valid[:, telling]
        log = CrossingLog(times, readings, valid)
        lines = with_free_frequency(self.lines.of_sensors(telling), times, readings)
        fits = vehicles_in(
            lines, log, settings.speeds, settings.both_ways, seen, settings.least_weight
        )
        if not fits:
            told = "explains the readings" if seen is None else "is told by the detectors"
            return [], [f"{about}no vehicle {told} at these speeds: not weighed"]
        places = [fit.geometry for fit in fits] if seen is None else []
        return [self._vehicle(fit, is_beside(fit.geometry, places)) for fit in fits], []

    def _stamp(self, time: float) -> str:
        """Date and time, or time of day, of an instant (s) of the log; "" if it has none."""
        if not self.start:
            return ""
        dated = "T" in self.start
        begin = datetime.datetime.fromisoformat(self.start if dated else f"0002-01-01T{self.start}")
        at = begin + datetime.timedelta(seconds=time - float(self.times[0]))
        return (at if dated else at.time()).isoformat(timespec="milliseconds")

    def _vehicle(self, fit: AxleFit, beside: bool) -> WeighedVehicle:
        """Row of the table for the fit of a vehicle, `beside` another one or not."""
        count, at = fit.forces.size, fit.geometry
        half, (gross, error) = fit.half_widths[:count], fit.gross_weight
        doubt = ""
        if fit.excess > MOST_EXCESS:
            doubt = f"residuals have {fit.excess:.3g} times the variance expected"
        elif not fit.is_plausible:
            doubt = "an axle is too light"
        elif gross < self.settings.least_weight:
            doubt = "lighter than what is weighed"
        elif beside:
            doubt = "another vehicle is beside it: how their weight is divided is not known"
        share = float(fit.half_widths[0] / fit.errors[0])  # Student's quantile
        return WeighedVehicle(
            self.name, at.entry_time, self._stamp(at.entry_time), at.speed, at.offsets.tolist(),
            fit.forces.tolist(), half.tolist(), gross, share * error,
            [len(group) for group in fit.groups], doubt,
        )  # fmt: skip


def is_beside(at: AxleGeometry, vehicles: Sequence[AxleGeometry]) -> bool:
    """Whether another one of the vehicles, in the same direction, enters while this one enters.

    Then both are side by side, and strains that both cause alike do not tell their weights apart.
    """
    begin, end = _entries(at)
    others = (_entries(one) for one in vehicles if one is not at and one.speed * at.speed > 0)
    return any(begin <= last and first <= end for first, last in others)


def _entries(at: AxleGeometry) -> tuple[float, float]:
    """Times (s) at which the first and the last axle of a vehicle enter."""
    return at.entry_time, at.entry_time + float(at.offsets[-1]) / abs(at.speed)


def _traffic(parts: Iterable[tuple[list[WeighedVehicle], list[str]]]) -> WeighedTraffic:
    """Table of the vehicles and problems found in parts of logs."""
    vehicles: list[WeighedVehicle] = []
    problems = []
    for found, more_problems in parts:
        vehicles += found
        problems += more_problems
    return WeighedTraffic(tuple(vehicles), tuple(problems))


class _Store(NamedTuple):
    """Store of vehicles: vehicles and problems by passing, number of passings by finished log."""

    path: Path
    found: dict[str, tuple[list[WeighedVehicle], list[str]]]
    whole: dict[str, int]

    @classmethod
    def opened(cls, path: Path, mark: str):
        """Store in a file, which is created if it is missing; a broken last line is dropped.

        Raises ValueError for a file that is no store, or of another case, lines, settings or
        reading.
        """
        store = cls(path, {}, {})
        if not path.exists():
            with whole_file(path) as partial:
                partial.write_text(json.dumps({"format": FORMAT, "mark": mark}) + "\n")
            return store
        text = read_text_input(path, "store of vehicles")
        head, *entries = text.split("\n")
        content = _entry(head)
        if content.get("format") != FORMAT:
            raise ValueError(f"{path} is no store of vehicles: give another name")
        if content.get("mark") != mark:
            raise ValueError(
                f"{path} was made with another case, other lines, settings or options of reading:"
                " give the same, or another store"
            )
        for entry in map(_entry, entries):
            if "whole" in entry:
                store.whole[entry["passing"]] = entry["whole"]
            elif "passing" in entry:
                vehicles = [WeighedVehicle(**one) for one in entry["vehicles"]]
                store.found[entry["passing"]] = vehicles, entry["problems"]
        if not text.endswith("\n"):  # so that the next entry begins a line
            with path.open("a", encoding="utf-8") as file:
                file.write("\n")
        return store

    def add(
        self, passing: str, vehicles: list[WeighedVehicle], problems: list[str], whole=None
    ) -> None:
        """Append a passing, or the number `whole` of passings of a log that is finished."""
        entry: dict[str, Any] = {"passing": passing}
        if whole is None:
            self.found[passing] = vehicles, problems
            entry |= {"vehicles": [one._asdict() for one in vehicles], "problems": problems}
        else:
            self.whole[passing] = entry["whole"] = whole
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")


def _entry(line: str) -> dict[str, Any]:
    """Entry of a line of the store; empty for an incomplete line."""
    try:
        found = json.loads(line)
    except json.JSONDecodeError:
        return {}
    return found if isinstance(found, dict) else {}


def _mark_of(
    case: Case, lines: InfluenceLines, settings: TrafficSettings, reading: dict[str, Any]
) -> str:
    """Hash of influence lines, sensor quantities, settings and how logs are read: of a store."""
    about = dataclasses.asdict(settings) | {"detectors": dict(settings.detectors)}
    sensors = [sensor.quantity for sensor in case.sensors]
    text = json.dumps([lines.to_dict(), sensors, about, reading])
    return hashlib.sha256(text.encode()).hexdigest()[:16]
