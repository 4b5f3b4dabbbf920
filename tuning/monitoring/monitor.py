"""Monitoring of a structure: modes over time, what conditions explain of them, alarms, figure.

Frequencies of the first logs (the baseline) are regressed on conditions such as the temperature,

    ln f = a + b (c - mean c) + e,

and all logs are compared with this. The chart is that of Lowry, Woodall, Champ and Rigdon, A
multivariate exponentially weighted moving average control chart, Technometrics 34, 1992: of the
standardised e of all modes, clipped where a log is an outlier, with Hotelling's T^2. Its limit is
the quantile of F for parameters that are estimated; correlation from log to log and the uncertainty
of the regression widen the distribution that it is compared with.
"""

import dataclasses
import os
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from jaxbeam.case.arguments import checks_classes
from jaxbeam.plot.style import ALARM, GREY, LIMIT_STYLE, colour, use_style
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.runtime.printer import TableViews, counted, text_table
from tuning.logs.readers.headings import epoch_seconds
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

WEIGHT = 0.2  # of the newest log in the moving average, usual for changes of about one deviation
MIN_FREE = 10  # logs more than coefficients, which a regression needs
CLIPPED = 3.0  # deviations; a log that is farther off is an outlier, not a change
ABSURD = 30.0  # robust deviations of a condition, beyond which its sensor has failed
OUTLIER = 4.0  # robust deviations, beyond which a log is left out of the regression
MAX_ROUNDS = 5
LEAST_CHANCE = 1e-300  # of a statistic, whose quantile would be infinite below
CONFIDENCE = 0.95


class ConditionEffect(NamedTuple):
    """Relative change of a frequency by a unit of a condition, and half its 95 % interval."""

    condition: str
    slope: float
    half_width: float


@dataclasses.dataclass(frozen=True)
class FrequencyRegression:
    """Frequencies of a track as its conditions explain them.

    `residuals` are ln f less what is predicted, `deviation` their standard deviation in the
    baseline, `leverage` what the uncertainty of the coefficients adds for each log.
    """

    predicted: Float[np.ndarray, " log"]
    residuals: Float[np.ndarray, " log"]
    leverage: Float[np.ndarray, " log"]
    deviation: float
    correlation: float
    freedom: int
    effects: tuple[ConditionEffect, ...]
    explained: float


@dataclasses.dataclass(frozen=True)
class ControlChart:
    """Control chart of the modes that have a baseline.

    `statistic` (log) is Hotelling's T^2, which exceeds the `limit` in a fraction `false_alarms` of
    the logs of an unchanged structure; NaN without a mode. `alarm` (log) is where it does after the
    `baseline`, the number of the first logs. `used` are the tracks, one regression for each.
    """

    statistic: Float[np.ndarray, " log"]
    limit: float
    alarm: Bool[np.ndarray, " log"]
    baseline: int
    false_alarms: float
    used: tuple[int, ...]
    regressions: tuple[FrequencyRegression, ...]
    conditions: tuple[str, ...]

    @property
    def since(self) -> int | None:
        """Index of the log from which on all that tell anything alarm; None without such."""
        known = np.flatnonzero(np.isfinite(self.statistic))
        quiet = known[~self.alarm[known]]
        after = known if not quiet.size else known[known > quiet[-1]]
        return int(after[0]) if after.size and self.alarm[after[0]] else None

    def change(self, first: int) -> list[tuple[float, float]]:
        """Relative change of each frequency from a log on, and half its 95 % interval."""
        found = []
        for one in self.regressions:
            here = np.arange(one.residuals.size) >= first
            here &= np.isfinite(one.residuals)
            count = int(here.sum())
            if not count:
                found.append((np.nan, np.nan))
                continue
            phi = one.correlation
            scatter = (1 + phi) / (1 - phi) / count
            shared = float(np.mean(one.leverage[here]))
            deviation = one.deviation * np.sqrt(scatter + shared)
            half = scipy.stats.t.ppf(0.5 + CONFIDENCE / 2, one.freedom) * deviation
            found.append((float(np.median(one.residuals[here])), float(half)))
        return found


def chart_of(
    tracks: Sequence[ModeTrack],
    conditions: Sequence[Mapping[str, float]],
    baseline: int,
    false_alarms: float = 2e-3,
) -> ControlChart | None:
    """ControlChart of tracks over logs with `conditions`, of which the first are the `baseline`.

    Conditions that all logs with modes have are used. None without a mode that is found in enough
    logs of the baseline.
    """
    names, matrix = _columns(conditions, baseline)
    rows = np.all(np.isfinite(matrix), axis=1)
    found = [_regression(track, matrix, rows, baseline, names) for track in tracks]
    used = [i for i, one in enumerate(found) if one is not None]
    regressions = tuple(one for one in found if one is not None)
    if not regressions:
        return None
    standard = np.array(
        [one.residuals / (one.deviation * np.sqrt(1 + one.leverage)) for one in regressions]
    )
    statistic, limit = _statistic(standard, regressions, baseline, false_alarms)
    with np.errstate(invalid="ignore"):
        alarm = (statistic > limit) & (np.arange(statistic.size) >= baseline)
    parts = baseline, false_alarms, tuple(used), regressions, names
    return ControlChart(statistic, limit, alarm, *parts)


def _columns(conditions: Sequence[Mapping[str, float]], baseline: int):
    """Names of the conditions that change in the baseline, and their values (log, condition).

    Those beyond what the baseline has by far, as -9999 of a sensor that failed, are NaN.
    """
    names = list(dict.fromkeys(name for one in conditions for name in one))
    table = np.array([[one.get(name, np.nan) for name in names] for one in conditions])
    table = table.reshape(len(conditions), len(names))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of a condition that no log has
        off = np.abs(table - np.nanmedian(table[:baseline], axis=0))
        usual = 1.4826 * np.nanmedian(off[:baseline], axis=0)
    table = np.where((usual > 0) & (off > ABSURD * usual), np.nan, table)
    own = table[:baseline]
    known = np.isfinite(own).sum(axis=0) >= MIN_FREE
    with np.errstate(all="ignore"):
        spread = np.where(known, np.nanmax(np.where(known, own, 0), axis=0, initial=-np.inf), 0)
        spread = spread - np.nanmin(np.where(known, own, 0), axis=0, initial=np.inf)
    kept = [i for i in range(len(names)) if known[i] and spread[i] > 0]
    return tuple(names[i] for i in kept), table[:, kept]


def _regression(
    track: ModeTrack,
    matrix: Float[np.ndarray, "log condition"],
    rows: Bool[np.ndarray, " log"],
    baseline: int,
    names: Sequence[str],
) -> FrequencyRegression | None:
    """FrequencyRegression of a track in the baseline, without outliers; None with too few logs."""
    values = np.log(track.frequencies)
    usable = np.isfinite(values) & rows
    fitted = usable & (np.arange(values.size) < baseline)
    coefficients = 1 + matrix.shape[1]
    if fitted.sum() < coefficients + MIN_FREE:
        return None
    middle, scale = matrix[fitted].mean(axis=0), matrix[fitted].std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    design = np.column_stack([np.ones(values.size), (matrix - middle) / scale])
    for _ in range(MAX_ROUNDS):
        solution = np.linalg.lstsq(design[fitted], values[fitted], rcond=None)[0]
        errors = values - design @ solution
        robust = 1.4826 * np.median(np.abs(errors[fitted]))
        kept = usable & (np.arange(values.size) < baseline) & (np.abs(errors) <= OUTLIER * robust)
        if robust == 0 or kept.sum() < coefficients + MIN_FREE or np.all(kept == fitted):
            break
        fitted = kept
    freedom = int(fitted.sum()) - coefficients
    variance = float(np.sum(errors[fitted] ** 2) / freedom)
    inverse = np.linalg.pinv(design[fitted].T @ design[fitted])
    leverage = np.einsum("li,ij,lj->l", design, inverse, design)
    own = errors[fitted]
    lagged = float(np.sum(own[1:] * own[:-1]) / max(np.sum(own**2), 1e-300))
    half = scipy.stats.t.ppf(0.5 + CONFIDENCE / 2, freedom) * np.sqrt(variance * np.diag(inverse))
    effects = tuple(
        ConditionEffect(name, float(solution[i + 1] / scale[i]), float(half[i + 1] / scale[i]))
        for i, name in enumerate(names)
    )
    total = float(np.var(values[fitted]))
    return FrequencyRegression(
        np.exp(design @ solution),
        np.where(usable, errors, np.nan),
        leverage,
        float(np.sqrt(max(variance, 1e-24))),
        float(np.clip(lagged, 0.0, 0.9)),
        freedom,
        effects,
        1 - variance * freedom / max(total * fitted.sum(), 1e-300),
    )


def _statistic(
    standard, regressions: Sequence[FrequencyRegression], baseline: int, false_alarms: float
):
    """Hotelling's T^2 of the moving averages of standardised errors (mode, log), and its limit."""
    count, logs = standard.shape
    own = np.clip(np.nan_to_num(standard[:, :baseline]), -CLIPPED, CLIPPED)
    seen = np.isfinite(standard[:, :baseline]).astype(float)
    pairs = np.maximum(seen @ seen.T, 1.0)
    correlation = own @ own.T / pairs
    size = np.sqrt(np.maximum(np.diag(correlation), 1e-12))
    correlation = correlation / np.outer(size, size)
    least = min(one.freedom for one in regressions)
    shrunk = min(1.0, count / least)  # towards independent modes, of few logs
    correlation = (1 - shrunk) * correlation + shrunk * np.eye(count)
    average, weights = np.zeros(count), np.zeros(count)  # and sums of squared weights
    statistic = np.full(logs, np.nan)
    phi = np.array([one.correlation for one in regressions])
    memory = (1 - WEIGHT) * phi
    widened = (1 + memory) / (1 - memory)  # of the average of errors that are alike one by one
    shared = np.zeros(count)  # what the uncertainty of the regressions adds
    for log in range(logs):
        here = np.isfinite(standard[:, log])
        if not here.any():
            continue
        values = np.clip(standard[:, log], -CLIPPED, CLIPPED)
        leverage = np.array([one.leverage[log] for one in regressions])
        average = np.where(here, (1 - WEIGHT) * average + WEIGHT * values, average)
        weights = np.where(here, (1 - WEIGHT) ** 2 * weights + WEIGHT**2, weights)
        root = np.sqrt(leverage / (1 + leverage))
        shared = np.where(here, (1 - WEIGHT) * shared + WEIGHT * root, shared)
        ready = weights > 0
        deviation = np.sqrt(weights * widened + shared**2)[ready]
        scaled = average[ready] / deviation
        part = correlation[np.ix_(ready, ready)]
        # Of fewer modes than all, as a quantile of as many.
        chance = scipy.stats.f.sf(*_as_f(scaled @ np.linalg.solve(part, scaled), part, least))
        chance = max(float(chance), LEAST_CHANCE)
        statistic[log] = scipy.stats.f.isf(chance, count, max(least - count + 1, 1))
        statistic[log] *= _factor(count, least)
    limit = _factor(count, least) * scipy.stats.f.isf(
        false_alarms, count, max(least - count + 1, 1)
    )
    return statistic, float(limit)


def _factor(count: int, freedom: int) -> float:
    """Ratio of T^2 of so many means, with a covariance of so many degrees of freedom, to F."""
    return count * freedom / max(freedom - count + 1, 1)


def _as_f(statistic: float, part, freedom: int) -> tuple[float, int, int]:
    count = len(part)
    return statistic / _factor(count, freedom), count, max(freedom - count + 1, 1)


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
        followed = f"{counted(len(self.tracks), 'mode')} followed in"
        followed = "; ".join(
            [f"{followed} {counted(len(entries), 'log')}", *self._undated, *self.come_and_gone]
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
