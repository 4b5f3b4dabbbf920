"""Modes of each log of a folder, kept in a file so that only new logs are analysed; tracks."""

import concurrent.futures
import concurrent.futures.process
import csv
import dataclasses
import json
import multiprocessing
import os
import re
import warnings
from collections.abc import Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Complex, Float, Int

from jaxbeam.runtime.input_file import read_text_input
from jaxbeam.runtime.interrupts import keeping
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.runtime.printer import counted
from jaxbeam.runtime.progress import ProgressBar
from tuning.logs.log import LogWarning
from tuning.logs.readers.headings import epoch_seconds
from tuning.logs.reading import read_log, version_of
from tuning.modal.identify_modes import ModalSettings, identify_modes
from tuning.modal.result import mac_matrix

FORMAT = "jaxbeam modes of logs 1"


@dataclasses.dataclass(frozen=True)
class AnalysisSettings:
    """Which logs of a folder are analysed, and how.

    Logs are the files that match the `pattern`. `columns` and `rate` (Hz) are those of
    `tuning.read_log`; `band` (Hz), `method` and `channels` those of `tuning.identify_modes`;
    `order` is the highest of the models.

    >>> AnalysisSettings(band=(0.5, 20.0)).to_dict()["band"]
    [0.5, 20.0]
    """

    pattern: str = "*"
    band: tuple[float, float] | None = None
    method: str | None = None
    channels: Sequence[str] | None = None
    columns: str | None = None
    rate: float | None = None
    order: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        found = dataclasses.asdict(self)
        for name in ("band", "channels"):
            found[name] = None if found[name] is None else list(found[name])
        return found


class LogModes(NamedTuple):
    """Modes of one log: frequencies (Hz) and damping ratios with deviations, and shapes.

    `start` is the date and time of the first sample, "" if the log has none; `conditions` are means
    of columns such as temperatures, by name. `problem` is the sentence why there are no modes, if
    there are none; `mark` tells a log from one that was changed. `channels` are the names of those
    that shapes have; without, shapes are compared by their places.
    """

    file: str
    mark: str
    start: str = ""
    frequencies: Float[np.ndarray, " mode"] = np.zeros(0)
    frequency_sds: Float[np.ndarray, " mode"] = np.zeros(0)
    damping_ratios: Float[np.ndarray, " mode"] = np.zeros(0)
    shapes: Complex[np.ndarray, "mode channel"] = np.zeros((0, 0), complex)
    conditions: Mapping[str, float] = {}
    problem: str = ""
    channels: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        found = self._asdict() | {"conditions": dict(self.conditions)}
        del found["shapes"]
        parts = {"shapes_real": self.shapes.real, "shapes_imag": self.shapes.imag}
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in (found | parts).items()
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "LogModes":
        """The entry of plain numbers."""
        arrays = {
            name: np.array(content[name], float)
            for name in ("frequencies", "frequency_sds", "damping_ratios")
        }
        parts = (np.array(content[f"shapes_{part}"], float) for part in ("real", "imag"))
        real, imag = (part.reshape(part.shape if part.size else (0, 0)) for part in parts)
        words = {name: content[name] for name in ("file", "mark", "start", "problem")}
        conditions = {name: float(value) for name, value in content["conditions"].items()}
        shapes, channels = real + 1j * imag, tuple(content.get("channels", ()))
        return cls(**words, **arrays, shapes=shapes, conditions=conditions, channels=channels)


@dataclasses.dataclass(frozen=True)
class ModeHistory:
    """Entries of a folder in the order of time, and how they were found."""

    entries: tuple[LogModes, ...]
    settings: Mapping[str, Any]

    def save(self, path: str | os.PathLike) -> None:
        """Write the history to a JSON file, in place of what was there, whole or not at all."""
        content = {"format": FORMAT, "settings": dict(self.settings)}
        content["entries"] = [entry.to_dict() for entry in self.entries]
        with whole_file(path, overwrite=True) as partial:
            partial.write_text(json.dumps(content), encoding="utf-8")


def read_history(path: str | os.PathLike) -> ModeHistory:
    """ModeHistory in a JSON file. Raises ValueError for a file that is none."""
    try:
        content = json.loads(read_text_input(path, "history of modes"))
        if content["format"] != FORMAT:
            raise ValueError(f"{os.fspath(path)} is a history of modes of another format")
        entries = tuple(map(LogModes.from_dict, content["entries"]))
        return ModeHistory(entries, content["settings"])
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{os.fspath(path)} is no history of modes ({error}): give another name"
        ) from None


def analyse(
    folder: str | os.PathLike,
    store: str | os.PathLike,
    settings: AnalysisSettings | None = None,
    *,
    processes: int = 1,
    progress: bool = False,
) -> ModeHistory:
    """Modes of all logs of a `folder`, of which those in the `store` are not analysed again.

    The store, a JSON file, is written after each log. The `settings` say which files are logs, but
    descriptions (.toml) and hidden ones, and how they are analysed. Logs that cannot be analysed
    have an entry with the reason; those that have left the folder keep theirs. More than one of the
    `processes` need a program whose main module may be imported; a bar shows `progress`.

    Raises FileNotFoundError without the folder, that of the store, or a log, ValueError for a store
    of other settings or of another folder, ChildProcessError if a process is ended from outside.
    """
    folder, store, settings = Path(folder), Path(store), settings or AnalysisSettings()
    told = settings.to_dict() | {"folder": str(folder.resolve())}
    files = logs_in(folder, settings.pattern, store)
    if not store.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {store.parent} to write {store.name} to")
    known: dict[str, LogModes] = {}
    if store.exists():
        former = read_history(store)
        changed = [k for k, v in settings.to_dict().items() if former.settings.get(k) != v]
        if changed:
            raise ValueError(
                f"{store} was made with another {changed[0]}"
                f" ({former.settings.get(changed[0])!r}, not {told[changed[0]]!r}): give the"
                " same, or another store"
            )
        known = {entry.file: entry for entry in former.entries}
        other = former.settings.get("folder") != told["folder"]
        if known and other and not any((folder / name).is_file() for name in known):
            raise ValueError(f"{store} has logs of another folder than {folder}: give another")
    marks = {path.relative_to(folder).as_posix(): version_of(path) for path in files}
    known = {name: one for name, one in known.items() if marks.get(name, one.mark) == one.mark}
    known = {name: one for name, one in known.items() if one.channels or one.problem}
    left = [path for path in files if path.relative_to(folder).as_posix() not in known]
    kept = keeping(lambda: f"{len(known)} of {len(files)} logs are in {store}: go on by the same")
    with (
        ProgressBar(len(files), "log", shown=progress, initial=len(files) - len(left)) as bar,
        kept,
    ):
        for path, entry in _analysed(left, settings, processes):
            name = path.relative_to(folder).as_posix()
            known[name] = entry._replace(file=name)
            _history(_without_repeats(known, marks), told).save(store)
            bar.update()
    return _history(_without_repeats(known, marks), told)


def _without_repeats(known: Mapping[str, LogModes], present: Container[str]) -> dict[str, LogModes]:
    """Entries of which those with the modes of another, to nine digits, have none.

    Such a log is a copy, or one that has been renamed: of the latter only the one that is `present`
    is kept.
    """
    found: dict[str, LogModes] = {}
    first: dict[tuple, str] = {}
    for name in sorted(known, key=lambda name: name not in present):
        entry = known[name]
        numbers = (*entry.frequencies.tolist(), *entry.damping_ratios.tolist())
        key = (entry.start, *(f"{number:.9g}" for number in numbers))
        other = first.setdefault(key, name) if numbers else name
        if other == name:
            found[name] = entry
        elif name in present:
            none = LogModes(name, entry.mark, entry.start)
            found[name] = none._replace(problem=f"it is a copy of {other}")
    return found


def logs_in(folder: Path, pattern: str, store: Path) -> list[Path]:
    """Files of a folder that match a pattern. Raises FileNotFoundError without one."""
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}")
    found = [
        path
        for path in sorted(folder.glob(pattern))
        if path.is_file()
        and path.suffix.lower() not in (".toml", ".png", ".md")
        and not path.name.startswith(".")
        and path.resolve() != store.resolve()
    ]
    if not found:
        raise FileNotFoundError(f"there is no log in {folder} that matches {pattern!r}")
    return found


def _history(known: Mapping[str, LogModes], settings: Mapping[str, Any]) -> ModeHistory:
    """ModeHistory of entries by the time of their first samples, or else by their names.

    Logs without a date that have no modes follow the one before them by name.
    """

    def by_name(entry: LogModes):
        numbers = re.split(r"(\d+)", entry.file)
        return [(int(part), "") if part.isdigit() else (-1, part) for part in numbers]

    entries = sorted(known.values(), key=by_name)
    dates = [epoch_seconds(entry.start) for entry in entries]
    if all(date or entry.problem for date, entry in zip(dates, entries, strict=True)):
        for i in range(1, len(dates)):
            dates[i] = dates[i] or dates[i - 1]
        entries = [entries[i] for i in np.argsort(dates, kind="stable")]
    return ModeHistory(tuple(entries), settings)


def _analysed(
    paths: Sequence[Path], settings: AnalysisSettings, processes: int
) -> Iterable[tuple[Path, LogModes]]:
    """Paths and entries of some logs, as they are found."""
    if processes <= 1 or len(paths) < 2:
        yield from ((path, entry_of(path, settings)) for path in paths)
        return
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(min(processes, len(paths)), context) as pool:
        futures = {pool.submit(entry_of, path, settings): path for path in paths}
        try:
            for future in concurrent.futures.as_completed(futures):
                yield futures[future], future.result()
        except concurrent.futures.process.BrokenProcessPool:
            raise ChildProcessError(
                "a process that analyses logs was ended from outside, as for want of memory: go on"
                " by the same call with fewer processes"
            ) from None
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def entry_of(path: Path, settings: AnalysisSettings) -> LogModes:
    """LogModes of one log."""
    mark, start = version_of(path), ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LogWarning)
            log = read_log(path, columns=settings.columns, rate=settings.rate)
            start = log.start
            fit = identify_modes(
                log,
                band=settings.band,
                method=settings.method,
                channels=settings.channels,
                settings=ModalSettings(order=settings.order),
            )
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        return LogModes(path.name, mark, start, problem=" ".join(str(error).split()))
    modes, count = fit.modes, len(fit.channels.names)
    return LogModes(
        path.name,
        mark,
        log.start,
        np.array([mode.frequency for mode in modes]),
        np.array([mode.frequency_sd for mode in modes]),
        np.array([mode.damping_ratio for mode in modes]),
        np.array([mode.shape for mode in modes], complex).reshape(len(modes), count),
        dict(log.conditions),
        "" if modes else "no mode is well identified",
        tuple(fit.channels.names),
    )


def read_conditions(path: str | os.PathLike) -> dict[str, dict[str, float]]:
    """Conditions by the name of a log, from a CSV table: names, then a column for each condition.

    Raises ValueError for a table without columns or rows, and for cells that are no numbers.
    """
    rows = list(csv.reader(read_text_input(path, "table of conditions").splitlines()))
    head, *body = [row for row in rows if row] or [[]]
    if len(head) < 2 or not body:
        raise ValueError(f"{path}: a table of conditions has the names of logs and a column more")
    known: dict[str, dict[str, float]] = {}
    for number, row in enumerate(body, 2):
        try:
            values = [float(cell) for cell in row[1:]]
        except ValueError:
            raise ValueError(f"{path}, line {number}: a condition is no number") from None
        if len(values) != len(head) - 1:
            raise ValueError(
                f"{path}, line {number}: it has {counted(len(row), 'cell')}, not {len(head)}"
            )
        known[Path(row[0].strip()).as_posix()] = dict(
            zip(map(str.strip, head[1:]), values, strict=True)
        )
    return known


def with_conditions(history: ModeHistory, known: Mapping[str, Mapping[str, float]]) -> ModeHistory:
    """The history with conditions, by the names of logs, beside those of the logs themselves.

    Names may leave out folders. Raises ValueError if they are those of none of its logs.
    """
    files = {entry.file for entry in history.entries}
    by_name = {Path(file).name: own for file, own in known.items() if file not in files}
    own = [known.get(one.file, by_name.get(Path(one.file).name)) for one in history.entries]
    if not any(own):
        raise ValueError("the table of conditions names no log of the folder in its first column")
    entries = tuple(
        entry._replace(conditions={**entry.conditions, **(new or {})})
        for entry, new in zip(history.entries, own, strict=True)
    )
    return dataclasses.replace(history, entries=entries)


MAX_STEP = 0.05  # relative change of a frequency from its last values; a day of frost is less
MIN_MAC = 0.7  # of a shape with the mean shape of its track
REMEMBERED = 5  # last frequencies, whose median is what the next is compared with
SHAPE_WEIGHT = 0.2  # of a new shape in the mean shape
GONE = 20  # logs without the mode, after which a track has ended
MIN_FRACTION = 0.3  # of the logs from its birth to its end in which a mode that counts is found
MIN_SEEN = 5  # logs in which it is found, or half of fewer than ten


@dataclasses.dataclass(frozen=True)
class ModeTrack:
    """One mode over the logs: frequencies (Hz), deviations and damping ratios, NaN where it is not.

    `mac` is that of each shape with the mean shape before. `born` and `last` are the indices of the
    first and the last log with it; it has `ended` if logs have gone on without it.
    """

    frequencies: Float[np.ndarray, " log"]
    deviations: Float[np.ndarray, " log"]
    damping_ratios: Float[np.ndarray, " log"]
    mac: Float[np.ndarray, " log"]
    born: int
    last: int
    ended: bool

    @property
    def seen(self) -> int:
        """Number of logs in which the mode is found."""
        return int(np.isfinite(self.frequencies).sum())


@dataclasses.dataclass
class _GrowingTrack:
    """A track while it grows: indices of logs and of modes in them."""

    logs: list[int]
    modes: list[int]
    mac: list[float]
    recent: list[float]
    shape: np.ndarray

    def add(self, log: int, mode: int, entry: LogModes, mac: float) -> None:
        shape = entry.shapes[mode]
        both = np.isfinite(shape) & np.isfinite(self.shape)
        phase = np.vdot(shape[both], self.shape[both])
        turned = shape * (phase / abs(phase) if abs(phase) > 0 else 1.0)
        scale = np.linalg.norm(turned[both]) or 1.0
        mixed = (1 - SHAPE_WEIGHT) * self.shape + SHAPE_WEIGHT * turned / scale
        former = np.where(np.isfinite(self.shape), self.shape, turned / scale)
        self.shape = np.where(np.isfinite(mixed), mixed, former)
        self.logs.append(log)
        self.modes.append(mode)
        self.mac.append(mac)
        self.recent = [*self.recent, float(entry.frequencies[mode])][-REMEMBERED:]


def tracks_of(entries: Sequence[LogModes]) -> list[ModeTrack]:
    """Tracks of the modes of logs in the order of time, ascending in frequency.

    Modes of a log are assigned to the tracks so that changes of frequency and shape (MAC) are least
    in sum; a mode without a track begins one, a track without a mode for GONE logs has ended. Those
    seen too seldom are left out. Shapes are compared on the channels that both have.
    """
    entries = _on_all_channels(entries)
    growing: list[_GrowingTrack] = []
    for number, entry in enumerate(entries):
        alive = [track for track in growing if number - track.logs[-1] <= GONE]
        taken = _assigned(entry, alive)
        for mode in range(entry.frequencies.size):
            if mode in taken:
                track, mac = taken[mode]
                alive[track].add(number, mode, entry, mac)
                continue
            size = np.sqrt(np.nansum(np.abs(entry.shapes[mode]) ** 2))
            shape = entry.shapes[mode] / (size or 1.0)
            frequency = float(entry.frequencies[mode])
            growing.append(_GrowingTrack([number], [mode], [1.0], [frequency], shape))
    tracks = [_finished(track, entries) for track in growing]
    least = min(MIN_SEEN, max(1, len(entries) // 2))
    kept = [
        track
        for track in tracks
        if track.seen >= least and track.seen >= MIN_FRACTION * (track.last - track.born + 1)
    ]
    return sorted(kept, key=lambda track: float(np.nanmedian(track.frequencies)))


def _on_all_channels(entries: Sequence[LogModes]) -> list[LogModes]:
    """Entries with shapes on all channels of all logs, by name; NaN where a log has none.

    Logs with as many channels, but all of other names, have the same in the same order.
    """
    places: dict[str, int] = {}
    found, before = [], ()
    for entry in entries:
        own = entry.channels or tuple(map(str, range(entry.shapes.shape[1])))
        if len(own) == len(before) and not places.keys() & set(own):
            own = before
        for name in own:
            places.setdefault(name, len(places))
        found.append(own)
        before = own or before
    wide = []
    for entry, own in zip(entries, found, strict=True):
        shapes = np.full((entry.frequencies.size, len(places)), np.nan, complex)
        if entry.frequencies.size:
            shapes[:, [places[name] for name in own]] = entry.shapes
        wide.append(entry._replace(shapes=shapes))
    return wide


def _assigned(entry: LogModes, alive: Sequence[_GrowingTrack]) -> dict[int, tuple[int, float]]:
    """ModeTrack and MAC of each mode of a log that continues one."""
    if not alive or not entry.frequencies.size:
        return {}
    before = np.array([np.median(track.recent) for track in alive])
    steps = np.abs(np.log(entry.frequencies[:, None] / before)) / np.log1p(MAX_STEP)
    mac = mac_matrix(entry.shapes, np.array([track.shape for track in alive]))
    allowed = (steps <= 1) & (mac >= MIN_MAC)
    cost = np.where(allowed, steps + (1 - mac) / (1 - MIN_MAC), 1e3)
    rows, columns = scipy.optimize.linear_sum_assignment(cost)
    return {
        int(row): (int(column), float(mac[row, column]))
        for row, column in zip(rows, columns, strict=True)
        if allowed[row, column]
    }


def _finished(track: _GrowingTrack, entries: Sequence[LogModes]) -> ModeTrack:
    logs: Int[np.ndarray, " seen"] = np.array(track.logs)

    def over_time(values):
        found = np.full(len(entries), np.nan)
        found[logs] = values
        return found

    columns = [
        over_time([getattr(entries[i], name)[k] for i, k in zip(logs, track.modes, strict=True)])
        for name in ("frequencies", "frequency_sds", "damping_ratios")
    ]
    found, deviations, ratios = columns
    ended = len(entries) - 1 - track.logs[-1] > GONE
    parts = found, deviations, ratios, over_time(track.mac)
    return ModeTrack(*parts, track.logs[0], track.logs[-1], ended)
