"""What a fit says, in words and tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxbeam.case.sensors import QUANTITIES
from tuning.fit.model_validation import channel_residuals, residual_remarks
from tuning.logs.quality import find_faults

if TYPE_CHECKING:
    from tuning.fit.identify import Fit
    from tuning.logs.log import Log

MAX_CORRELATION = 0.95  # correlation beyond which two numbers are said to be hard to tell apart
PRIOR_DOMINANCE = (
    0.7  # of the prior's deviation: with a larger error the logs say less than the prior
)


def fit_table(fit: Fit) -> str:
    """A table of values with 95 % intervals, then what is unseen, correlated or at a bound."""
    header = ("number", "unit", "start", "fitted", "95 % interval")
    rows = [header, *_parameter_rows(fit)]
    a, b, c, d = (max(len(row[i]) for row in rows) for i in range(4))
    lines = [
        f"{name:{a}}  {unit:{b}}  {start:>{c}}  {value:>{d}}  {interval}"
        for name, unit, start, value, interval in rows
    ]
    return "\n".join([*lines, *minima_table(fit), "", *remarks(fit), fit.verdict])


def remarks(fit: Fit) -> list[str]:
    """All that is to be said of a fit besides its numbers, in a sentence each."""
    return [
        *_bound_remarks(fit),
        *_unidentifiable_remarks(fit),
        *_correlation_remarks(fit),
        *_prior_remarks(fit),
        *_noise_remarks(fit),
        *residual_remarks(channel_residuals(fit), fit.dataset.logs),
        *log_remarks(fit.dataset.logs),
    ]


def log_remarks(logs: Sequence[Log]) -> list[str]:
    """What was noted when logs were read, and faults that were found and not masked."""
    sentences = []
    for log in logs:
        sentences += [f"{log.source}: {note}" for note in log.notes]
        sentences += [f"{fault} (not masked)" for fault in find_faults(log)]
    return sentences


def minima_table(fit: Fit) -> list[str]:
    """The minima that several starts led to, lowest first; nothing for a single start."""
    if not fit.minima:
        return []
    lines = ["", f"{len(fit.minima)} minima from {sum(m.starts for m in fit.minima)} starts:"]
    for found in fit.minima:
        values = "  ".join(f"{value:.5g}" for value in found.values)
        state = "" if found.converged else "  (not converged)"
        lines.append(f"  misfit {found.cost:.6g} from {found.starts} starts: {values}{state}")
    return lines


def _parameter_rows(fit: Fit):
    for number, value, interval in zip(fit.parameters, fit.values, fit.intervals, strict=True):
        interval_text = "the data cannot tell"
        if np.all(np.isfinite(interval)):
            interval_text = f"{interval[0]:.5g} to {interval[1]:.5g}"
        unit = "" if number.unit == "1" else number.unit
        yield number.address, unit, f"{number.start:.5g}", f"{value:.5g}", interval_text


def _bound_remarks(fit: Fit):
    for number, value in zip(fit.parameters, fit.values, strict=True):
        if number.at_bound(value):
            yield (
                f"{number.address} ended at its bound ({number.low:.5g} to {number.high:.5g}): "
                "the logs fit best there or beyond, and the intervals do not hold; "
                "widen the bounds if they may be wrong"
            )


def _unidentifiable_remarks(fit: Fit):
    """The directions that the data cannot see, by name."""
    units = {number.address: number.unit for number in fit.parameters}
    for direction in fit.unidentifiable:
        if len(direction) == 1:
            yield f"the data cannot see {next(iter(direction))}: give it a value known otherwise"
            continue
        changes = [f"{a} by {change:+.3g} {units[a]}" for a, change in direction.items()]
        yield (
            f"the data cannot see a change of {', '.join(changes)} together: "
            "give one of them a value known otherwise"
        )


def _correlation_remarks(fit: Fit):
    for i, j in np.argwhere(np.triu(np.abs(np.nan_to_num(fit.correlation)) > MAX_CORRELATION, 1)):
        yield (
            f"{fit.addresses[i]} and {fit.addresses[j]} are hard to tell apart: "
            f"correlation {fit.correlation[i, j]:.3f}"
        )


def _prior_remarks(fit: Fit):
    for number, error in zip(fit.parameters, fit.errors, strict=True):
        deviation = number.prior.deviation
        if deviation is not None and error > PRIOR_DOMINANCE * deviation:
            yield f"{number.address} is told by its prior more than by the logs"


def _noise_remarks(fit: Fit):
    units = [QUANTITIES[sensor.quantity] for sensor in fit.case.sensors]
    for log, noise in zip(fit.dataset.logs, fit.noise, strict=True):
        pairs = enumerate(zip(noise, units, strict=True))
        levels = [f"{n:.3g} {unit} (sensor {i})" for i, (n, unit) in pairs if np.isfinite(n)]
        yield f"standard deviation of the residual of {log.source}: {', '.join(levels)}"
