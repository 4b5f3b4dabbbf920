"""Comparison of controllers on one case, with the uncontrolled run and the least achievable peak.

A new metric takes a field of `PerformanceMetrics`, its value in `performance_metrics`, and a column
and a key in `jaxbeam.cli.commands.compare`.
"""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.bound.bound import DEFAULT_PERIOD, Bound, bound
from jaxbeam.analysis.limit_cycles import CommandOscillation, command_oscillations
from jaxbeam.analysis.margins import StabilityMargin, stability_margin
from jaxbeam.case.case import Case, crossing_times
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import refuses_traced
from jaxbeam.runtime.module import Module
from jaxbeam.runtime.printer import TableViews
from jaxbeam.simulation.commands import with_exact_compensation
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import ContactLossWarning, simulate


class PerformanceMetrics(NamedTuple):
    """Performance metrics of a controller on a case.

    Deflections are those at the sensors, the largest of all: `peak` (m) in continuous time, `rms`
    (m) over the samples of the run, `after_exit` (m) the largest after the last load has left, NaN
    if the run ends before. For each actuator `effort` is the integral of the squared command over
    the run (command^2 s), `saturated` the fraction of samples at a limit. `share` is the fraction
    of the attainable reduction of the peak (see `Bound.share`), `stability_margin` the margin along
    the crossing, `limit_cycles` the oscillation of each command.
    """

    peak: float
    rms: float
    after_exit: float
    effort: Float[np.ndarray, " actuator"]
    saturated: Float[np.ndarray, " actuator"]
    share: float
    stability_margin: StabilityMargin
    limit_cycles: tuple[CommandOscillation, ...]


class Comparison(TableViews, Module):
    """Result of `compare`: records and metrics of the controllers by name, and the bound.

    `uncontrolled` is the run without controller, `optimal` the run with the commands of the bound.
    """

    case: Case
    uncontrolled: Record
    optimal: Record
    records: dict[str, Record]
    metrics: dict[str, PerformanceMetrics]
    bound: Bound

    @property
    def headline(self) -> str:
        """Peaks without control and under the bound, in one sentence."""
        return self.bound.verdict

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Name and metrics of each controller, by head, as `PerformanceMetrics` has them.

        Efforts are (controller, actuator) in that class, columns here; margins are NaN where the
        loop has none.
        """
        metrics = self.metrics.values()
        efforts = np.array([one.effort for one in metrics]).T
        limits = np.array([one.saturated for one in metrics]).T
        return {
            "controller": np.array(list(self.metrics)),
            "peak (m)": np.array([one.peak for one in metrics]),
            "share of attainable reduction": np.array([one.share for one in metrics]),
            "RMS (m)": np.array([one.rms for one in metrics]),
            "after exit (m)": np.array([one.after_exit for one in metrics]),
            **{f"effort {i} (command^2 s)": effort for i, effort in enumerate(efforts)},
            **{f"time at limit {i}": limit for i, limit in enumerate(limits)},
            "gain margin": np.array([one.stability_margin.gain for one in metrics]),
            "delay margin (s)": np.array([one.stability_margin.delay for one in metrics]),
        }

    @property
    def remarks(self) -> list[str]:
        """Sentences on margins that are missing, loops, and the verdicts of the records."""
        obstacles = {name: one.stability_margin.obstacle for name, one in self.metrics.items()}
        remarks = []
        for obstacle in dict.fromkeys(filter(None, obstacles.values())):
            names = [name for name, found in obstacles.items() if found == obstacle]
            remarks.append(f"no margin of {', '.join(names)}: {obstacle}")
        for name, record in self.records.items():
            verdicts = filter(None, (self.loop_summary(name), record.verdict))
            remarks.append(f"{name}: {'; '.join(verdicts)}")
        return remarks

    def loop_summary(self, name: str) -> str:
        """Sentence on saturation, instability under stationary loads and oscillation of commands.

        Empty if there is none of them.
        """
        metrics = self.metrics[name]
        parts = []
        if metrics.saturated.any():
            fractions = ", ".join(f"{fraction:.1%}" for fraction in metrics.saturated)
            parts.append(f"at the limits {fractions} of the run")
        if metrics.stability_margin.unstable is not None:
            parts.append(str(metrics.stability_margin))
        for i, oscillation in enumerate(metrics.limit_cycles):
            if oscillation.oscillates:
                how = "is in a limit cycle" if oscillation.limit_cycle else "oscillates"
                parts.append(
                    f"command {i} {how}, with {oscillation.extra} turning points more than the"
                    f" uncontrolled deflection, at {oscillation.frequency:.3g} Hz"
                )
        return "; ".join(parts)


@refuses_traced("a comparison")
def compare(
    case: Case, controllers: dict[str, AbstractController], period: float | None = None
) -> Comparison:
    """Simulate a case under controllers, without control, and with the commands of its bound.

    The bound is that of commands held over `period` (s), by default the shortest period of the
    controllers, or 0.01 s, starting at its multiples. A controller of the case itself is left out
    unless it is given too. Contact loss is in the verdicts of the records; there is no warning.

    Raises ValueError without controllers, for a case that is invalid with one of them (which it
    names), and as `bound`.
    """
    if not controllers:
        raise ValueError("there is nothing to compare: give at least one controller")
    uncontrolled_case = dataclasses.replace(case, controller=None)
    periods = [float(c.period) for c in controllers.values() if c.period is not None]
    period = min(periods, default=DEFAULT_PERIOD) if period is None else period
    least_peak = bound(uncontrolled_case, period=period)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        uncontrolled = simulate(uncontrolled_case)
        records = {name: _simulate_with(case, name, one) for name, one in controllers.items()}
        exact_case = with_exact_compensation(case)  # commands of the bound are those that act
        optimal = _simulate_with(exact_case, "the bound", least_peak.controller())
    metrics = {
        name: performance_metrics(record, uncontrolled, least_peak)
        for name, record in records.items()
    }
    return Comparison(uncontrolled_case, uncontrolled, optimal, records, metrics, least_peak)


class MetricsOverCases(NamedTuple):
    """Performance metrics of a controller over several load cases.

    `peak` (m), `after_exit` (m, NaN if a run ends before the last exit) and `saturated` (fraction
    of a run that an actuator is at a limit) are the largest of all cases, `worst_share` and
    `mean_share` the least and the mean fraction of the attainable reduction.
    """

    peak: float
    worst_share: float
    mean_share: float
    after_exit: float
    saturated: float


def metrics_over_cases(comparisons: Sequence[Comparison]) -> dict[str, MetricsOverCases]:
    """Metrics by controller over comparisons of the same controllers on several load cases."""
    table = {}
    for name in comparisons[0].metrics:
        metrics = [comparison.metrics[name] for comparison in comparisons]
        # Not of runs in which nothing can be attained; NaN where one diverges.
        shares = [one.share for one in metrics if np.isnan(one.peak) or not np.isnan(one.share)]
        shares = shares or [np.nan]
        table[name] = MetricsOverCases(
            peak=float(np.max([one.peak for one in metrics])),
            worst_share=float(np.min(shares)),
            mean_share=float(np.mean(shares)),
            after_exit=float(np.max([one.after_exit for one in metrics])),
            saturated=float(np.max([one.saturated for one in metrics])),
        )
    return table


def worst_comparison(comparisons: Sequence[Comparison], name: str) -> int:
    """Index of the comparison in which a controller achieves the least of the attainable reduction.

    Divergence is less than any; runs in which nothing can be attained count last.
    """
    metrics = [comparison.metrics[name] for comparison in comparisons]
    shares = [-np.inf if np.isnan(one.peak) else one.share for one in metrics]
    return int(np.argmin(np.nan_to_num(shares, nan=np.inf, neginf=-np.inf)))


def _simulate_with(case: Case, name: str, controller: AbstractController) -> Record:
    try:
        return simulate(dataclasses.replace(case, controller=controller))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def performance_metrics(
    record: Record, uncontrolled: Record, least_peak: Bound
) -> PerformanceMetrics:
    """Metrics of a run, given the uncontrolled run and the bound of its case."""
    deflection, times = np.asarray(record.deflection), np.asarray(record.times)
    after_exit = np.abs(deflection[times > crossing_times(record.case)[:, 1].max()])
    return PerformanceMetrics(
        peak=float(np.max(record.peak_deflection)),
        rms=float(np.sqrt(np.mean(deflection**2, axis=0)).max()),
        after_exit=float(after_exit.max()) if after_exit.size else np.nan,
        effort=np.asarray(record.effort),
        saturated=np.asarray(record.saturated).mean(axis=0),
        share=least_peak.share(record),
        stability_margin=stability_margin(record.case),
        limit_cycles=command_oscillations(record, uncontrolled),
    )
