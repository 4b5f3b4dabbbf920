"""What a tuning has come to: before and after, training and held out, beside the bound."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from tuning.control.load_cases import AddressValues, value_columns
from tuning.control.objective import Objective
from tuning.parameters.free import FreeParameter

LIMIT_TOLERANCE = 0.01  # of a limit: excess that is not spoken of


@dataclasses.dataclass(frozen=True, eq=False)
class RunSetResult:
    """Runs before and after tuning. Peaks in m; `least_peaks` is the bound, NaN where not asked for.

    `objective_values` are those of the objective (before and after, by run), `objective` the one number for
    all runs; `saturated_share` is the share of the run that commands spend at a limit, and `merits` all
    figures of merit of the runs together, both after tuning.
    """

    name: str
    runs: tuple[AddressValues, ...]
    uncontrolled_peaks: Float[np.ndarray, " run"]
    peaks_before: Float[np.ndarray, " run"]
    peaks_after: Float[np.ndarray, " run"]
    least_peaks: Float[np.ndarray, " run"]
    objective_values: Float[np.ndarray, "2 run"]
    saturated_share: Float[np.ndarray, " run"]
    objective: list[float]
    merits: dict[str, float] = dataclasses.field(default_factory=dict)

    def attained_shares(self, peaks: Float[np.ndarray, " run"]) -> Float[np.ndarray, " run"]:
        """Shares of the attainable reduction that peaks stand for, run by run."""
        return (self.uncontrolled_peaks - peaks) / (self.uncontrolled_peaks - self.least_peaks)


class StartResult(NamedTuple):
    """Where one of several starts came to: the objective (with its price), and the values."""

    value: float
    values: Float[np.ndarray, " free"]


@dataclasses.dataclass(frozen=True, eq=False)
class TuningResult:
    """Result of a tuning: the tuned case, and what it does to training and held-out runs.

    `history` holds the true objective by step and start, NaN where the loop diverged, which
    happened `rejected_steps` times. `stability_violation` (1/s) is by how much a pole lies too far right for the
    constraint on stability, zero if it is met or was not asked for. `start_results` are the best that
    each start has met, lowest first.
    """

    case: Case
    parameters: list[FreeParameter]
    values: Float[np.ndarray, " free"]
    objective: Objective
    history: Float[np.ndarray, "step start"]
    rejected_steps: int
    run_sets: list[RunSetResult]
    stability_violation: float = 0.0
    start_results: tuple[StartResult, ...] = ()

    @property
    def limit_excess(self) -> dict[str, float]:
        """The limits that training or held-out runs exceed, and by how much at most."""
        found = {
            name: max(outcome.merits[name] for outcome in self.run_sets) - limit
            for name, limit in self.objective.limits.items()
        }
        return {
            name: amount
            for name, amount in found.items()
            if amount > LIMIT_TOLERANCE * self._limit(name)
        }

    def _limit(self, name: str) -> float:
        return self.objective.limits[name]

    @property
    def verdict(self) -> str:
        """The result in one sentence; the worst of the held-out runs is part of it."""
        deciding = self.run_sets[-1]
        relative = deciding.peaks_after / deciding.uncontrolled_peaks
        worst = int(np.argmax(relative))
        start, end = self.run_sets[0].objective
        sentence = f"objective on training {start:.4g} before, {end:.4g} after"
        if not math.isfinite(deciding.peaks_after.max()):
            return f"{sentence}; a {deciding.name} run diverges: not fit for use"
        sentence += (
            f"; worst {deciding.name} run: peak {1 - relative[worst]:.1%} below no control"
            f" ({1 - deciding.peaks_before[worst] / deciding.uncontrolled_peaks[worst]:.1%} before tuning)"
        )
        if np.isfinite(deciding.least_peaks).all():
            shares = deciding.attained_shares(deciding.peaks_after)
            sentence += (
                f"; of the attainable reduction at least {shares.min():.1%},"
                f" {shares.mean():.1%} in the mean"
            )
        if self.stability_violation > 0:
            sentence += f"; not as stable as asked for: a pole lies {self.stability_violation:.3g} 1/s too far right"
        for name, amount in self.limit_excess.items():
            sentence += f"; {name} exceeds its limit of {self._limit(name):.4g} by {amount:.3g}"
        if deciding.name == "training":
            sentence += "; nothing was held out, so this proves nothing for other loads"
        return sentence

    def __str__(self) -> str:
        lines = [f"{'number':<34}{'before':>14}{'after':>14}  unit"]
        for number, value in zip(self.parameters, self.values, strict=True):
            mark = "  (at a bound)" if number.at_bound(value) else ""
            lines.append(
                f"{number.address:<34}{number.start:>14.6g}{value:>14.6g}  {number.unit}{mark}"
            )
        for outcome in self.run_sets:
            lines += ["", *_run_table(outcome)]
        if len(self.start_results) > 1:
            lines += ["", "minima by start:", *_start_lines(self.start_results)]
        if self.rejected_steps:
            lines += [
                "",
                f"{self.rejected_steps} steps came to a loop that diverges and were taken back",
            ]
        return "\n".join([*lines, "", self.verdict])

    def to_dict(self) -> dict:
        """The result as plain numbers and words, for JSON."""
        pairs = zip(self.parameters, self.values, strict=True)
        return {
            "numbers": {
                n.address: {"before": n.start, "after": float(value), "unit": n.unit}
                for n, value in pairs
            },
            "runs": {
                outcome.name: {
                    "cases": list(outcome.runs),
                    **{
                        name: [x if math.isfinite(x) else None for x in map(float, entries)]
                        for name, entries in (
                            ("uncontrolled_peak", outcome.uncontrolled_peaks),
                            ("peak_before", outcome.peaks_before),
                            ("peak_after", outcome.peaks_after),
                            ("least_peak", outcome.least_peaks),
                            ("saturated", outcome.saturated_share),
                        )
                    },
                    "objective_before": outcome.objective[0],
                    "objective_after": outcome.objective[1],
                }
                for outcome in self.run_sets
            },
            "minima": [
                {"objective": m.value, "values": m.values.tolist()}
                for m in self.start_results
                if math.isfinite(m.value)
            ],
            "excess_of_limits": self.limit_excess,
            "rejected_steps": self.rejected_steps,
            "stability_violation": self.stability_violation,
            "verdict": self.verdict,
        }

    def plot(self):
        """Figure of the peaks of all runs, before, after and least, and of the search."""
        from jaxbeam.plot import TuningPanel, plot_tuning

        panels = [
            TuningPanel(
                title=f"{outcome.name} runs",
                labels=_run_labels(outcome),
                uncontrolled=outcome.uncontrolled_peaks,
                before=outcome.peaks_before,
                after=outcome.peaks_after,
                least_peak=outcome.least_peaks,
            )
            for outcome in self.run_sets
        ]
        return plot_tuning(panels, self.history, title=self.case.title)


def _run_labels(outcome: RunSetResult) -> list[str]:
    """What is special about each run, in short: the last word of each address and its value."""
    return [
        ", ".join(f"{address.rsplit('.', 1)[-1]} {value:g}" for address, value in run.items())
        for run in outcome.runs
    ]


def _start_lines(minima: tuple[StartResult, ...]) -> list[str]:
    """A line for each start: the objective, and the values it belongs to."""
    lines = []
    for found in minima:
        values = "  ".join(f"{value:.5g}" for value in found.values)
        line = f"{found.value:.6g}: {values}" if math.isfinite(found.value) else "diverges"
        lines.append(f"  objective {line}")
    return lines


def _run_table(outcome: RunSetResult) -> list[str]:
    """A table of the runs of one kind, with a line for the worst and the mean."""
    varied = value_columns(outcome.runs)
    names = [*varied, "no control", "before", "after", "least", "share before", "share after"]
    before, after = (
        outcome.attained_shares(outcome.peaks_before),
        outcome.attained_shares(outcome.peaks_after),
    )
    widths = [max(len(name) + 2, 12) for name in names]
    lines = [
        f"{outcome.name} runs: peaks in mm, shares of the attainable reduction",
        "".join(f"{name:>{w}}" for name, w in zip(names, widths, strict=True)),
    ]
    for i in range(len(outcome.runs)):
        peaks = (
            outcome.uncontrolled_peaks,
            outcome.peaks_before,
            outcome.peaks_after,
            outcome.least_peaks,
        )
        cells = [f"{column[i]:.4g}" for column in varied.values()]
        cells += [f"{1e3 * peak[i]:.4f}" for peak in peaks]
        cells += [f"{before[i]:.1%}", f"{after[i]:.1%}"]
        lines.append("".join(f"{cell:>{w}}" for cell, w in zip(cells, widths, strict=True)))
    return lines
