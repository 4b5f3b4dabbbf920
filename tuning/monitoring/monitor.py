"""Monitoring of a structure: modes over time, what conditions explain of them, alarms, figure."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxbeam.case.arguments import checks_classes
from jaxbeam.plot.style import ALARM, GREY, LIMIT_STYLE, colour, use_style
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.runtime.printer import TableViews, text_table
from tuning.logs.readers.headings import epoch_seconds
from tuning.monitoring.chart import ControlChart, chart_of
from tuning.monitoring.history import (
    MAX_STEP,
    REMEMBERED,
    AnalysisSettings,
    ModeHistory,
    ModeTrack,
    analyse,
    read_conditions,
    tracks_of,
    with_conditions,
)

MAX_PANELS = 8  # modes; the lowest of more
QUANTILE = 1.96


@use_style
def plot_monitoring(
    count: int,
    all_tracks: Sequence[ModeTrack],
    chart: ControlChart | None,
    path: str | os.PathLike | None = None,
) -> Figure:
    """Tracks over so many logs, a panel for each with what conditions explain, and the chart.

    It is saved to `path` if given.
    """
    tracks = all_tracks[:MAX_PANELS]
    panels = max(len(tracks) + (chart is not None), 1)
    figure = Figure(figsize=(8.0, 1.0 + 1.7 * panels))
    axes = np.atleast_1d(figure.subplots(panels, sharex=True))
    logs = np.arange(count)
    for number, (own, track) in enumerate(zip(axes, tracks, strict=False)):
        if chart is not None and number in chart.used:
            fit = chart.regressions[chart.used.index(number)]
            half = QUANTILE * fit.deviation * np.sqrt(1 + fit.leverage)
            low, high = fit.predicted * np.exp(-half), fit.predicted * np.exp(half)
            own.fill_between(logs, low, high, color=GREY, alpha=0.25, linewidth=0)
        own.plot(logs, track.frequencies, ".", color=colour(number), markersize=4)
        own.set_ylabel("frequency (Hz)")
        own.set_title(f"mode {number + 1}")
    if chart is not None:
        own = axes[len(tracks)]
        own.plot(logs, chart.statistic, ".", color=GREY, markersize=4)
        here = chart.alarm
        own.plot(logs[here], chart.statistic[here], "o", color=ALARM, markersize=4, label="alarm")
        own.axhline(chart.limit, **LIMIT_STYLE, label="limit")
        own.axvline(chart.baseline - 0.5, color=GREY, linewidth=0.8, label="end of the baseline")
        own.set_yscale("log")
        own.set_ylabel("Hotelling's $T^2$")
        own.set_title("control chart of what conditions do not explain")
        own.legend(ncols=3, fontsize=7)
    axes[-1].set_xlabel("log")
    if path is not None:
        with whole_file(path, overwrite=True) as partial:
            figure.savefig(partial)
    return figure


BASELINE = 50  # logs
MAX_LISTED = 5  # logs without modes, in the text


@dataclasses.dataclass(frozen=True, eq=False)
class Monitoring(TableViews):
    """Modes of a folder of logs over time; see `monitor`.

    `tracks` are the modes followed, ascending in frequency; the `chart` is None without enough logs
    for a baseline.

    >>> from tuning.monitoring.history import ModeHistory
    >>> from tuning.monitoring.monitor import monitored
    >>> print(monitored(ModeHistory((), {})).verdict)
    no mode is found in enough of 0 logs to be followed
    """

    history: ModeHistory
    tracks: tuple[ModeTrack, ...]
    chart: ControlChart | None
    baseline: int

    @property
    def verdict(self) -> str:
        """Whether the structure has changed, from which log on, and by how much."""
        entries, chart = self.history.entries, self.chart
        if not self.tracks:
            return f"no mode is found in enough of {len(entries)} logs to be followed"
        followed = f"{len(self.tracks)} mode{'s' * (len(self.tracks) > 1)} followed in"
        followed = "; ".join(
            [f"{followed} {len(entries)} logs", *self._undated, *self.come_and_gone]
        )
        if chart is None:
            return (
                f"{followed}; no control chart: no mode is in enough of the first {self.baseline}"
                " logs (the baseline), with the conditions of the others"
            )
        after = int(np.isfinite(chart.statistic[self.baseline :]).sum())
        followed = "; ".join([followed, *self._untold])
        if chart.since is not None:
            changes = [
                f"{_frequency(self.tracks[i]):.4g} Hz by {100 * value:+.2f} +- {100 * half:.2f} %"
                for i, (value, half) in zip(chart.used, chart.change(chart.since), strict=True)
                if np.isfinite(value)
            ]
            return (
                f"{followed}; ALARM since {entries[chart.since].file}: frequencies have changed"
                f" from what conditions explain, {', '.join(changes)}; a rigidity changes by twice"
                " as much where all change alike"
            )
        passing = int(chart.alarm.sum())
        expected = chart.false_alarms * after
        return (
            f"{followed}; the chart has no alarm in the last of {after} logs after the baseline of"
            f" {self.baseline}; {passing} passed, {expected:.1f} are expected without a change"
        )

    @property
    def _undated(self) -> list[str]:
        """Sentence on the order of logs of which some only have a date."""
        known = [one for one in self.history.entries if not one.problem]
        undated = [one.file for one in known if not epoch_seconds(one.start)]
        if len(undated) in (0, len(known)):
            return []
        return [f"the order is that of names, as {undated[0]} has no date"]

    @property
    def _untold(self) -> list[str]:
        """Sentence on logs with modes after the baseline of which the chart tells nothing."""
        entries, chart = self.history.entries, self.chart
        if chart is None:
            return []
        silent = [
            i
            for i in range(self.baseline, len(entries))
            if entries[i].frequencies.size and np.isnan(chart.statistic[i])
        ]
        if not silent:
            return []
        known = [np.isfinite(self.tracks[i].frequencies[silent]).any() for i in chart.used]
        why = f"{' or '.join(chart.conditions)} being unknown or far from all others"
        why = why if any(known) else "without the modes of the baseline"
        first = entries[silent[0]].file
        return [f"{len(silent)} logs after the baseline, as {first}, tell nothing, {why}"]

    @property
    def come_and_gone(self) -> list[str]:
        """Sentences on modes that ended or began after the baseline, as by a large change."""
        files = [entry.file for entry in self.history.entries]
        found = []
        for track in self.tracks:
            if track.ended and track.last >= self.baseline:
                found.append(f"{_frequency(track):.4g} Hz is not found after {files[track.last]}")
            if track.born >= self.baseline:
                found.append(f"{_frequency(track):.4g} Hz is found since {files[track.born]} only")
        new = [track for track in self.tracks if track.born >= self.baseline]
        if new and all(any(_goes_on(one, track) for one in self.tracks) for track in new):
            found[-1] += " (shapes have changed, not frequencies: has a sensor been turned?)"
        return [f"ALARM: {', '.join(found)}"] if found else []

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """One row a log: file, start, conditions, and of each mode what was found and predicted."""
        entries, chart = self.history.entries, self.chart
        found: dict[str, np.ndarray] = {
            "file": np.array([entry.file for entry in entries], str),
            "start": np.array([entry.start for entry in entries], str),
        }
        for name in dict.fromkeys(name for entry in entries for name in entry.conditions):
            found[name] = np.array([entry.conditions.get(name, np.nan) for entry in entries])
        for number, track in enumerate(self.tracks, 1):
            found[f"mode {number} frequency (Hz)"] = track.frequencies
            found[f"mode {number} standard deviation (Hz)"] = track.deviations
            found[f"mode {number} damping ratio"] = track.damping_ratios
            found[f"mode {number} MAC"] = track.mac
            if chart is not None and number - 1 in chart.used:
                own = chart.regressions[chart.used.index(number - 1)]
                found[f"mode {number} predicted (Hz)"] = own.predicted
        if chart is not None:
            found |= {"statistic": chart.statistic, "alarm": chart.alarm.astype(float)}
        found["problem"] = np.array([entry.problem for entry in entries], str)
        return found

    def __str__(self) -> str:
        header = ["mode", "frequency (Hz)", "logs", "first", "last", "scatter (%)", "explained"]
        rows, entries = [], self.history.entries
        names = self.chart.conditions if self.chart is not None else ()
        for number, track in enumerate(self.tracks, 1):
            row = [f"{number}", f"{_frequency(track):.5g}", f"{track.seen}"]
            row += [entries[track.born].file]
            row += [f"{entries[track.last].file}{', ended' * track.ended}"]
            if self.chart is None or number - 1 not in self.chart.used:
                rows.append([*row, *[""] * (2 + len(names))])
                continue
            own = self.chart.regressions[self.chart.used.index(number - 1)]
            row += [f"{100 * own.deviation:.2g}", f"{100 * own.explained:.0f} %" * bool(names)]
            row += [f"{100 * e.slope:+.3g} +- {100 * e.half_width:.2g}" for e in own.effects]
            rows.append(row)
        lines = [self.verdict, ""]
        lines += text_table([*header, *(f"% per {name}" for name in names)], rows)
        failed = [entry for entry in entries if entry.problem]
        lines += [f"{entry.file}: {entry.problem}" for entry in failed[:MAX_LISTED]]
        if len(failed) > MAX_LISTED:
            lines.append(f"{len(failed) - MAX_LISTED} more logs without modes")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON: the verdict, alarms, effects of conditions, the rows."""
        chart, files = self.chart, [entry.file for entry in self.history.entries]
        content: dict[str, Any] = {"verdict": self.verdict, "come_and_gone": self.come_and_gone}
        content["columns"] = self.columns
        if chart is not None:
            content |= {
                "limit": chart.limit,
                "alarms": [files[i] for i in np.flatnonzero(chart.alarm)],
                "since": None if chart.since is None else files[chart.since],
                "effects": {
                    f"mode {i + 1}": {e.condition: [e.slope, e.half_width] for e in own.effects}
                    for i, own in zip(chart.used, chart.regressions, strict=True)
                },
            }
        return content

    @checks_classes
    def plot(self, path: str | os.PathLike | None = None) -> Any:
        """Figure of the frequencies, what conditions explain of them, and the control chart.

        It is saved to `path` if given.
        """

        files = len(self.history.entries)
        return plot_monitoring(files, self.tracks, self.chart, path)


def _frequency(track: ModeTrack) -> float:
    return float(np.nanmedian(track.frequencies))


def _goes_on(before: ModeTrack, after: ModeTrack) -> bool:
    """Whether a track ends where another begins, at a frequency that it could have gone on to."""
    last = before.frequencies[np.isfinite(before.frequencies)][-REMEMBERED:]
    first = after.frequencies[np.isfinite(after.frequencies)][:REMEMBERED]
    step = abs(float(np.log(np.median(first) / np.median(last))))
    return before.last < after.born and step <= float(np.log1p(MAX_STEP))


@checks_classes
def monitor(
    folder: str | os.PathLike,
    store: str | os.PathLike,
    settings: AnalysisSettings | None = None,
    *,
    conditions: str | os.PathLike | None = None,
    baseline: int = BASELINE,
    processes: int = 1,
    progress: bool = False,
) -> Monitoring:
    """Follow the modes of a structure through the logs of a `folder`, and tell when they change.

    Modes of new logs are found by `tuning.identify_modes`, and kept in the `store`, a JSON file;
    those of logs that have not changed are taken from it. They are followed by frequency and MAC
    (see `tracks_of`). Of the first logs, the `baseline`, frequencies are regressed on `conditions`:
    columns of the logs without a unit of vibrations, as temperatures, and those of a CSV table with
    the names of logs in its first column. A control chart of what remains has the alarms (see
    `chart_of`). Logs are in the order of their dates, if all have one, else of their names; the
    `settings` say which they are and how they are analysed. So many `processes` analyse them at
    once; a bar shows `progress`.

    Raises FileNotFoundError without the folder or a log, ValueError for a baseline below two, a
    store of other settings and a table of conditions that names no log.

    >>> from pathlib import Path
    >>> import numpy as np
    >>> import tuning
    >>> Path("bridge").mkdir()
    >>> times = 0.005 * np.arange(1600)
    >>> for day in range(3):
    ...     decay = np.exp(-0.3 * times) * np.cos(2 * np.pi * (3.2 - 0.1 * day) * times)
    ...     noise = 1e-3 * np.random.default_rng(day).normal(size=times.size)
    ...     rows = [f"{t:.3f},{a:.6f}" for t, a in zip(times, decay + noise)]
    ...     _ = Path(f"bridge/{day}.csv").write_text("\\n".join(["t [s],a [m/s^2]", *rows]))
    >>> found = tuning.monitoring.monitor("bridge", "modes.json")
    >>> print(found.tracks[0].frequencies.round(2))
    [3.2 3.1 3. ]
    """
    if baseline < 2:
        raise ValueError(f"the baseline must be 2 logs at least, not {baseline}")
    known = None if conditions is None else read_conditions(conditions)  # before any work
    history = analyse(folder, store, settings, processes=processes, progress=progress)
    return monitored(history, known, baseline)


def monitored(
    history: ModeHistory,
    conditions: Mapping[str, Mapping[str, float]] | None = None,
    baseline: int = BASELINE,
) -> Monitoring:
    """Tracks and control chart of a history of modes, and of conditions by the names of logs.

    See `monitor`. Raises ValueError for conditions of none of its logs.
    """
    if conditions is not None:
        history = with_conditions(history, conditions)
    tracks = tuple(tracks_of(history.entries))
    chart = chart_of(tracks, [entry.conditions for entry in history.entries], baseline)
    return Monitoring(history, tracks, chart, baseline)
