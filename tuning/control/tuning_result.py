"""What a tuning has come to: before and after, training and held out, beside the bound."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from tuning.control.load_cases import Values, columns
from tuning.control.objective import Objective
from tuning.parameters.free import Free

SLIGHT = 0.01  # of a limit: excess that is not spoken of


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """Runs before and after tuning. Peaks in m; `least` is the bound, NaN where not asked for.

    `values` are those of the objective (before and after, by run), `objective` the one number for
    all runs; `saturated` is the share of the run that commands spend at a limit, and `merits` all
    figures of merit of the runs together, both after tuning.
    """

    name: str
    runs: tuple[Values, ...]
    uncontrolled: Float[np.ndarray, " run"]
    before: Float[np.ndarray, " run"]
    after: Float[np.ndarray, " run"]
    least: Float[np.ndarray, " run"]
    values: Float[np.ndarray, "2 run"]
    saturated: Float[np.ndarray, " run"]
    objective: list[float]
    merits: dict[str, float] = dataclasses.field(default_factory=dict)

    def shares(self, peaks: Float[np.ndarray, " run"]) -> Float[np.ndarray, " run"]:
        """Shares of the attainable reduction that peaks stand for, run by run."""
        return (self.uncontrolled - peaks) / (self.uncontrolled - self.least)


class Minimum(NamedTuple):
    """Where one of several starts came to: the objective (with its price), and the values."""

    value: float
    values: Float[np.ndarray, " free"]


@dataclasses.dataclass(frozen=True, eq=False)
class Tuned:
    """Result of a tuning: the tuned case, and what it does to training and held-out runs.

    `history` holds the true objective by step and start, NaN where the loop diverged, which
    happened `rejected` times. `violation` (1/s) is by how much a pole lies too far right for the
    constraint on stability, zero if it is met or was not asked for. `minima` are the best that
    each start has met, lowest first.
    """

    case: Case
    numbers: list[Free]
    values: Float[np.ndarray, " free"]
    objective: Objective
    history: Float[np.ndarray, "step start"]
    rejected: int
    outcomes: list[Outcome]
    violation: float = 0.0
    minima: tuple[Minimum, ...] = ()

    @property
    def excess(self) -> dict[str, float]:
        """The limits that training or held-out runs exceed, and by how much at most."""
        found = {
            name: max(outcome.merits[name] for outcome in self.outcomes) - limit
            for name, limit in self.objective.limits.items()
        }
        return {name: much for name, much in found.items() if much > SLIGHT * self._limit(name)}

    def _limit(self, name: str) -> float:
        return self.objective.limits[name]

    @property
    def verdict(self) -> str:
        """The result in one sentence; the worst of the held-out runs is part of it."""
        judged = self.outcomes[-1]
        relative = judged.after / judged.uncontrolled
        worst = int(np.argmax(relative))
        start, end = self.outcomes[0].objective
        words = f"objective on training {start:.4g} before, {end:.4g} after"
        if not math.isfinite(judged.after.max()):
            return f"{words}; a {judged.name} run diverges: not fit for use"
        words += (
            f"; worst {judged.name} run: peak {1 - relative[worst]:.1%} below no control"
            f" ({1 - judged.before[worst] / judged.uncontrolled[worst]:.1%} before tuning)"
        )
        if np.isfinite(judged.least).all():
            shares = judged.shares(judged.after)
            words += (
                f"; of the attainable reduction at least {shares.min():.1%},"
                f" {shares.mean():.1%} in the mean"
            )
        if self.violation > 0:
            words += (
                f"; not as stable as asked for: a pole lies {self.violation:.3g} 1/s too far right"
            )
        for name, much in self.excess.items():
            words += f"; {name} exceeds its limit of {self._limit(name):.4g} by {much:.3g}"
        if judged.name == "training":
            words += "; nothing was held out, so this proves nothing for other loads"
        return words

    def __str__(self) -> str:
        lines = [f"{'number':<34}{'before':>14}{'after':>14}  unit"]
        for number, value in zip(self.numbers, self.values, strict=True):
            mark = "  (at a bound)" if number.at_bound(value) else ""
            lines.append(
                f"{number.address:<34}{number.start:>14.6g}{value:>14.6g}  {number.unit}{mark}"
            )
        for outcome in self.outcomes:
            lines += ["", *_rows(outcome)]
        if len(self.minima) > 1:
            lines += ["", "minima by start:", *_minima(self.minima)]
        if self.rejected:
            lines += ["", f"{self.rejected} steps came to a loop that diverges and were taken back"]
        return "\n".join([*lines, "", self.verdict])

    def to_dict(self) -> dict:
        """The result as plain numbers and words, for JSON."""
        pairs = zip(self.numbers, self.values, strict=True)
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
                            ("uncontrolled_peak", outcome.uncontrolled),
                            ("peak_before", outcome.before),
                            ("peak_after", outcome.after),
                            ("least_peak", outcome.least),
                            ("saturated", outcome.saturated),
                        )
                    },
                    "objective_before": outcome.objective[0],
                    "objective_after": outcome.objective[1],
                }
                for outcome in self.outcomes
            },
            "minima": [
                {"objective": m.value, "values": m.values.tolist()}
                for m in self.minima
                if math.isfinite(m.value)
            ],
            "excess_of_limits": self.excess,
            "rejected_steps": self.rejected,
            "stability_violation": self.violation,
            "verdict": self.verdict,
        }

    def plot(self):
        """Figure of the peaks of all runs, before, after and least, and of the search."""
        from jaxbeam.plot import TuningPanel, plot_tuning

        panels = [
            TuningPanel(
                title=f"{outcome.name} runs",
                labels=_labels(outcome),
                uncontrolled=outcome.uncontrolled,
                before=outcome.before,
                after=outcome.after,
                least=outcome.least,
            )
            for outcome in self.outcomes
        ]
        return plot_tuning(panels, self.history, title=self.case.title)


def _labels(outcome: Outcome) -> list[str]:
    """What is special about each run, in short: the last word of each address and its value."""
    return [
        ", ".join(f"{address.rsplit('.', 1)[-1]} {value:g}" for address, value in run.items())
        for run in outcome.runs
    ]


def _minima(minima: tuple[Minimum, ...]) -> list[str]:
    """A line for each start: the objective, and the values it belongs to."""
    lines = []
    for found in minima:
        values = "  ".join(f"{value:.5g}" for value in found.values)
        told = f"{found.value:.6g}: {values}" if math.isfinite(found.value) else "diverges"
        lines.append(f"  objective {told}")
    return lines


def _rows(outcome: Outcome) -> list[str]:
    """A table of the runs of one kind, with a line for the worst and the mean."""
    varied = columns(outcome.runs)
    names = [*varied, "no control", "before", "after", "least", "share before", "share after"]
    before, after = outcome.shares(outcome.before), outcome.shares(outcome.after)
    widths = [max(len(name) + 2, 12) for name in names]
    lines = [
        f"{outcome.name} runs: peaks in mm, shares of the attainable reduction",
        "".join(f"{name:>{w}}" for name, w in zip(names, widths, strict=True)),
    ]
    for i in range(len(outcome.runs)):
        peaks = (outcome.uncontrolled, outcome.before, outcome.after, outcome.least)
        cells = [f"{column[i]:.4g}" for column in varied.values()]
        cells += [f"{1e3 * peak[i]:.4f}" for peak in peaks]
        cells += [f"{before[i]:.1%}", f"{after[i]:.1%}"]
        lines.append("".join(f"{cell:>{w}}" for cell, w in zip(cells, widths, strict=True)))
    return lines
