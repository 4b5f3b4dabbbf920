"""Several controllers on the same case, beside no control and the best that is possible.

To add a figure of merit, give `PerformanceMetrics` a field, `performance_metrics` its value and the table of
`jaxbeam compare` (in `cli.compare`) a column.
"""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.bound.bound import DEFAULT_PERIOD, Bound, bound
from jaxbeam.analysis.computing_time import ComputingTimes, computing_times
from jaxbeam.analysis.crossing_margin import StabilityMargin, stability_margin
from jaxbeam.analysis.limit_cycles import CommandOscillation, command_oscillations
from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.loads import trajectory
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import ContactLossWarning, simulate


class PerformanceMetrics(NamedTuple):
    """How a controller does on a case; deflections are those of the sensor where they are largest.

    Peak (m), at samples and in between; root mean square (m) over the run; largest deflection (m)
    after the last load has left, NaN if the run ends before; effort of each actuator (the integral
    of its squared command); share of the run that each spends at a limit; times (s) that steps take
    to compute; share of the attainable reduction of the peak; stability margins; and how each
    command swings more often than the beam does without control.
    """

    peak: float
    rms: float
    after_exit: float
    effort: Float[np.ndarray, " actuator"]
    saturated: Float[np.ndarray, " actuator"]
    step_times: ComputingTimes
    share: float
    reserve: StabilityMargin
    swings: tuple[CommandOscillation, ...]


class Comparison(eqx.Module):
    """What `compare` returns: the bound, and by name records and merits of the controllers.

    `uncontrolled` is the run without control, `optimal` that with the commands of the `bound`.
    """

    case: Case
    uncontrolled: Record
    optimal: Record
    records: dict[str, Record]
    metrics: dict[str, PerformanceMetrics]
    bound: Bound

    def loop_summary(self, name: str) -> str:
        """In words: how much a controller is at its limits, and whether its loop holds still."""
        merits = self.metrics[name]
        parts = []
        if merits.saturated.any():
            shares = ", ".join(f"{share:.1%}" for share in merits.saturated)
            parts.append(f"at its limits {shares} of the run")
        unstable = merits.reserve.unstable
        if unstable is not None:
            parts.append(
                f"unstable with the loads parked where they are from t = {unstable.start:.3g} to"
                f" {unstable.end:.3g} s: deviations grow by {unstable.rate:.3g} 1/s at {unstable.frequency:.3g}"
                " Hz, so lower the gains, or shorten filters and delays"
            )
        for i, one in enumerate(merits.swings):
            if one.oscillates:
                how = "in a limit cycle" if one.limit_cycle else "to and fro"
                parts.append(
                    f"command {i} swings {how}, {one.extra} times more than the beam without"
                    f" control, at {one.frequency:.3g} Hz"
                )
        return "; ".join(parts)


def compare(
    case: Case, controllers: dict[str, AbstractController], period: float | None = None
) -> Comparison:
    """Run several controllers on the same case, and the commands that attain its bound.

    The bound is for commands held over `period` (s), by default the shortest of the controllers'
    own, or 0.01 s; it holds for those that begin at its multiples. The case's own controller is
    left out unless it is among those given. Loads that would have to pull are named by the verdicts
    of the records, not by warnings.

    Raises ValueError for a case that is faulty, with one of the controllers (named) or for a bound.
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
        optimal = _simulate_with(case, "the bound", least_peak.controller())
    metrics = {
        name: performance_metrics(record, uncontrolled, least_peak)
        for name, record in records.items()
    }
    return Comparison(uncontrolled_case, uncontrolled, optimal, records, metrics, least_peak)


class MetricsOverCases(NamedTuple):
    """How a controller does over several load cases.

    Its largest peak (m); the least and the mean share of the attainable reduction; the largest
    deflection (m) after the last exit, NaN if a run ends before; the largest share of a run that an
    actuator spends at a limit.
    """

    peak: float
    worst_share: float
    mean_share: float
    after_exit: float
    saturated: float


def metrics_over_cases(comparisons: Sequence[Comparison]) -> dict[str, MetricsOverCases]:
    """By controller, how it does over comparisons of the same controllers on several load cases."""
    table = {}
    for name in comparisons[0].metrics:
        metrics = [one.metrics[name] for one in comparisons]
        shares = [merits.share for merits in metrics]
        table[name] = MetricsOverCases(
            peak=float(np.max([merits.peak for merits in metrics])),
            worst_share=float(np.min(shares)),
            mean_share=float(np.mean(shares)),
            after_exit=float(np.max([merits.after_exit for merits in metrics])),
            saturated=float(np.max([merits.saturated for merits in metrics])),
        )
    return table


def _simulate_with(case: Case, name: str, controller: AbstractController) -> Record:
    try:
        return simulate(dataclasses.replace(case, controller=controller))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def performance_metrics(
    record: Record, uncontrolled: Record, least_peak: Bound
) -> PerformanceMetrics:
    """The merits of a run, held against the run without control and the bound of its case."""
    deflection, times = np.asarray(record.deflection), np.asarray(record.times)
    exit_times = [
        trajectory(load, record.case.beam.length).entry_exit_times()[1]
        for load in record.case.loads
    ]
    after_exit = np.abs(deflection[times > max(float(end) for end in exit_times)])
    return PerformanceMetrics(
        peak=float(np.max(record.peak_deflection)),
        rms=float(np.sqrt(np.mean(deflection**2, axis=0)).max()),
        after_exit=float(after_exit.max()) if after_exit.size else np.nan,
        effort=np.asarray(record.effort),
        saturated=np.asarray(record.saturated).mean(axis=0),
        step_times=computing_times(record),
        share=least_peak.share(record),
        reserve=stability_margin(record.case),
        swings=command_oscillations(record, uncontrolled),
    )
