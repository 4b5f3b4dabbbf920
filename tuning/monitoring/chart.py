"""What conditions explain of frequencies, and a control chart of what they do not.

Frequencies of the first logs (the baseline) are regressed on conditions such as the temperature,

    ln f = a + b (c - mean c) + e,

and all logs are compared with this. The chart is that of Lowry, Woodall, Champ and Rigdon, A
multivariate exponentially weighted moving average control chart, Technometrics 34, 1992: of the
standardised e of all modes, clipped where a log is an outlier, with Hotelling's T^2. Its limit is
the quantile of F for parameters that are estimated; correlation from log to log and the uncertainty
of the regression widen the distribution that it is compared with.
"""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float

from tuning.monitoring.history import ModeTrack

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
