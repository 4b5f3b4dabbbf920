"""Result of a tuning, compared with the controller before.

The laws are designed for the case as it is; what a run changes of the plant they do not know.
"""

import dataclasses
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.bound.bound import no_bound
from jaxbeam.analysis.compare import Comparison, compare
from jaxbeam.case.case import Case, replace, unit_at, value_at
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import concrete
from jaxbeam.case.validation import check_case
from jaxbeam.control.feedforward import hand_drawn_law
from jaxbeam.model.modes import mesh_layout
from jaxbeam.runtime.printer import TableViews, text_table
from jaxbeam.simulation.simulate import ContactLossWarning, simulate
from tuning.control.objective import Objective, with_fixed_design
from tuning.control.run_set import PLANT_PREFIXES, AddressValues, run_case, value_columns
from tuning.parameters import FreeParameter

DETUNING = 0.0, -0.05, 0.05  # relative errors of the frequencies of absorbers
LIMIT_TOLERANCE = 0.01  # fraction of a limit by which it may be exceeded without a remark


@dataclasses.dataclass(frozen=True, eq=False)
class RunSetResult:
    """Runs of a run set before and after tuning.

    Peaks are in m; `least_peaks` are the least achievable ones, NaN if not computed.
    `saturated_share` is the fraction of the time after tuning in which a command is at a limit;
    `objective` has the values before and after; `metrics` are those after tuning, aggregated, and
    `metrics_before` those before it. `detuned` are the objectives after tuning with all absorbers
    off by the errors DETUNING; empty without absorbers.
    """

    name: str
    runs: tuple[AddressValues, ...]
    uncontrolled_peaks: Float[np.ndarray, " run"]
    peaks_before: Float[np.ndarray, " run"]
    peaks_after: Float[np.ndarray, " run"]
    least_peaks: Float[np.ndarray, " run"]
    saturated_share: Float[np.ndarray, " run"]
    objective: list[float]
    metrics: dict[str, float] = dataclasses.field(default_factory=dict)
    metrics_before: dict[str, float] = dataclasses.field(default_factory=dict)
    detuned: list[float] = dataclasses.field(default_factory=list)

    def attained_shares(self, peaks: Float[np.ndarray, " run"]) -> Float[np.ndarray, " run"]:
        """Fraction of the attainable reduction that peaks (m) attain, by run."""
        return (self.uncontrolled_peaks - peaks) / (self.uncontrolled_peaks - self.least_peaks)

    def attained_words(self, peaks: Float[np.ndarray, " run"]) -> str:
        """Words on the attained shares at the end of a sentence; "" without least peaks."""
        if not np.isfinite(self.least_peaks).all():
            return ""
        shares = self.attained_shares(peaks)
        return (
            f"; of the attainable reduction at least {shares.min():.1%},"
            f" {shares.mean():.1%} in the mean"
        )


class StartResult(NamedTuple):
    """Best point of one of several starts: the objective, penalties included, and the values."""

    value: float
    values: Float[np.ndarray, " parameter"]


@dataclasses.dataclass(frozen=True, eq=False)
class TuningResult(TableViews):
    """Result of a tuning: the tuned case, and its training and held-out runs.

    `history` is the true objective by step and start, NaN where the closed loop was unstable, which
    happened in `rejected_steps`. `stability_violation` (1/s) is the excess of the real part of a
    pole over the stability constraint, 0 if that is met or not given. `start_results` are the best
    points of all starts, lowest objective first.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.load_case("case.toml")
    >>> loads = tuning.LoadCases(({"loads.0.mass": 0.2},), ({"loads.0.mass": 0.3},))
    >>> free = {"controller.gains.0": (100.0, 5000.0)}
    >>> options = {"steps": 3, "least_peaks": False, "progress": False}
    >>> result = tuning.tune(case, free, loads, **options)
    >>> print(result.history.shape, len(result.run_sets))
    (3, 1) 2
    >>> print(result.case.controller.gains.round())
    [767.]
    """

    case: Case
    parameters: list[FreeParameter]
    values: Float[np.ndarray, " parameter"]
    objective: Objective
    history: Float[np.ndarray, "step start"]
    rejected_steps: int
    run_sets: list[RunSetResult]
    stability_violation: float = 0.0
    start_results: tuple[StartResult, ...] = ()

    @property
    def limit_excess(self) -> dict[str, float]:
        """Largest excess, by metric, of the limits that training or held-out runs exceed."""
        found = {
            name: max(outcome.metrics[name] for outcome in self.run_sets) - limit
            for name, limit in self.objective.limits.items()
        }
        return {
            name: amount
            for name, amount in found.items()
            if amount > LIMIT_TOLERANCE * self.objective.limits[name]
        }

    @property
    def verdict(self) -> str:
        """The result in one sentence, with the worst of the held-out runs."""
        last = self.run_sets[-1]
        reductions = 1 - last.peaks_after / last.uncontrolled_peaks
        worst = int(np.argmin(reductions))
        before = 1 - last.peaks_before[worst] / last.uncontrolled_peaks[worst]
        start, end = self.run_sets[0].objective
        sentence = f"objective on training {start:.4g} before, {end:.4g} after"
        if not math.isfinite(last.peaks_after.max()):
            return f"{sentence}; a {last.name} run diverges: not fit for use"
        sentence += (
            f"; worst {last.name} run: peak {against_no_control(reductions[worst])}"
            f" ({against_no_control(before, reductions[worst])} before tuning)"
        )
        if attained := last.attained_words(last.peaks_after):
            sentence += attained
        elif obstacle := no_bound(self.case):
            sentence += f"; no least achievable peaks, as {obstacle}"
        if self.stability_violation > 0:
            sentence += (
                "; the stability constraint is violated: the real part of a pole is"
                f" {self.stability_violation:.3g} 1/s too large"
            )
        for name, amount in self.limit_excess.items():
            limit = self.objective.limits[name]
            sentence += f"; {name} exceeds its limit of {limit:.4g} by {amount:.3g}"
        if last.name == "training":
            sentence += "; nothing was held out, so this proves nothing for other loads"
        return sentence

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Address, unit, and value before and after of each tuned parameter, by head."""
        return {
            "parameter": np.array([one.address for one in self.parameters]),
            "unit": np.array(["" if one.unit == "1" else one.unit for one in self.parameters]),
            "before": np.array([one.start for one in self.parameters]),
            "after": np.asarray(self.values),
        }

    def __str__(self) -> str:
        pairs = zip(self.parameters, self.values, strict=True)
        marks = {True: "(at a bound)", False: ""}
        rows = [
            (p.address, f"{p.start:.6g}", f"{x:.6g}", p.unit, marks[bool(p.at_bound(x))])
            for p, x in pairs
        ]
        lines = text_table(("parameter", "before", "after", "unit", ""), rows, "<>><<")
        for outcome in self.run_sets:
            lines += ["", *_run_table(self.case, outcome)]
        lines += ["", *_metric_table(self.objective, self.run_sets)]
        lines += _detuned_table(self.run_sets)
        if len(self.start_results) > 1:
            lines += ["", "minima by start:", *_start_lines(self.start_results)]
        if self.rejected_steps:
            lines += [
                "",
                f"{self.rejected_steps} steps led to an unstable closed loop and were taken back",
            ]
        return "\n".join([*lines, "", self.verdict])

    def to_dict(self) -> dict:
        """Plain numbers and words for JSON."""
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
                    "objective_detuned": outcome.detuned,
                    "metrics": {
                        name: {"before": outcome.metrics_before.get(name), "after": value}
                        for name, value in outcome.metrics.items()
                    },
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
        """Figure of the peaks of all runs before and after, their least peaks, and the search."""
        from jaxbeam.plot import TuningPanel, plot_tuning

        panels = [
            TuningPanel(
                title=f"{outcome.name} runs",
                labels=_run_labels(self.case, outcome),
                uncontrolled=outcome.uncontrolled_peaks,
                before=outcome.peaks_before,
                after=outcome.peaks_after,
                least_peak=outcome.least_peaks,
            )
            for outcome in self.run_sets
        ]
        return plot_tuning(panels, self.history, title=self.case.title)


def against_no_control(reduction: float, other: float = -math.inf) -> str:
    """A reduction in words, as "20% below no control".

    Without the words where an `other` reduction before it has them.
    """
    side = "below" if reduction >= 0 else "above"
    same_side = (reduction >= 0) == (other >= 0) and math.isfinite(other)
    return f"{abs(reduction):.1%}" if same_side else f"{abs(reduction):.1%} {side} no control"


def _metric_table(objective: Objective, run_sets: list[RunSetResult]) -> list[str]:
    """Lines of a table of the metrics that were tuned or limited, before and after, by run set."""
    header, rows = ["metric", "weight", "limit"], []
    for outcome in run_sets:
        header += [f"{outcome.name} before", "after"]
    for name in dict.fromkeys([*objective.weights, *objective.limits]):
        if not all(name in o.metrics and name in o.metrics_before for o in run_sets):
            return []
        values = [v for o in run_sets for v in (o.metrics_before[name], o.metrics[name])]
        chosen = (objective.weights.get(name), objective.limits.get(name))
        settings = ["-" if value is None else f"{value:g}" for value in chosen]
        rows.append([name, *settings, *(f"{value:.4g}" for value in values)])
    words = {"worst": "worst of the runs", "mean": "mean of the runs"}
    tail = f"mean of the worst {objective.tail_share:.0%} of the runs"
    return [
        f"what was tuned, {words.get(objective.aggregation, tail)}",
        *text_table(header, rows, "<" + ">" * (len(header) - 1)),
    ]


def _detuned_table(run_sets: list[RunSetResult]) -> list[str]:
    """Lines of a table of the objective with absorbers off their frequencies; none without any."""
    if not run_sets[0].detuned:
        return []
    rows = [
        [f"{error:+.0%}" if error else "none", *(f"{o.detuned[i]:.4g}" for o in run_sets)]
        for i, error in enumerate(DETUNING)
    ]
    header = ["error", *(outcome.name for outcome in run_sets)]
    title = "objective with all frequencies of absorbers in error, damping ratios or rates kept"
    return ["", title, *text_table(header, rows, ">" * len(header))]


def _run_labels(case: Case, outcome: RunSetResult) -> list[str]:
    """A label for each run: the last word of each address that varies, its value and unit."""
    units = {address: unit_at(case, address) for run in outcome.runs for address in run}
    return [
        ", ".join(
            f"{address.rsplit('.', 1)[-1]} {value:g} {units[address]}".removesuffix(" 1").rstrip()
            for address, value in run.items()
        )
        for run in outcome.runs
    ]


def _start_lines(minima: tuple[StartResult, ...]) -> list[str]:
    """A line for each start: the objective at its best point, and the values there."""
    lines = []
    for found in minima:
        values = "  ".join(f"{value:.5g}" for value in found.values)
        line = f"{found.value:.6g}: {values}" if math.isfinite(found.value) else "diverges"
        lines.append(f"  objective {line}")
    return lines


def _of_case(case: Case, address: str) -> str:
    """The number of the case at an address that a run leaves as it is; a dash for a count."""
    try:
        return f"{float(value_at(case, address)):.4g}"
    except ValueError:
        return "-"


def _run_table(case: Case, run_set: RunSetResult) -> list[str]:
    """Lines of a table of the runs of a run set: what varies, peaks (mm), attained shares."""
    varied = value_columns(run_set.runs)
    peaks = {
        "no control": run_set.uncontrolled_peaks,
        "before": run_set.peaks_before,
        "after": run_set.peaks_after,
    }
    title, shares = f"{run_set.name} runs: peaks in mm", {}
    if np.isfinite(run_set.least_peaks).any():
        title += ", shares of the attainable reduction"
        shares = {
            f"share {name}": run_set.attained_shares(peaks[name]) for name in ("before", "after")
        }
        peaks["least"] = run_set.least_peaks
    rows = [
        [
            *(
                _of_case(case, name) if np.isnan(column[i]) else f"{column[i]:.4g}"
                for name, column in varied.items()
            ),
            *(f"{1e3 * own[i]:.4f}" for own in peaks.values()),
            *(f"{own[i]:.1%}" for own in shares.values()),
        ]
        for i in range(len(run_set.runs))
    ]
    units = {name: unit_at(case, name) for name in varied}
    heads = [name if units[name] in ("", "1") else f"{name} ({units[name]})" for name in varied]
    header = [*heads, *peaks, *shares]
    return [title, *text_table(header, rows, ">" * len(header))]


HAND_DRAWN = "drawn by hand"
OF_CONTROLLER = "controller."


def compare_runs(
    case: Case,
    controllers: Mapping[str, AbstractController],
    runs: Sequence[AddressValues],
    period: float | None = None,
) -> list[Comparison]:
    """Controllers on each of some runs, compared with a hand-drawn law, no control and the bound.

    Runs are values by address, as `tuning.latin_hypercube` draws them. Values of the beam, its
    supports, actuators and sensors are unknown to the laws, which are designed for the `case`;
    those of `controller`, as its delay, are those of every controller that has them. The law drawn
    by hand has the shortest period, the delay and the gates of the others. `period` (s) is that of
    the bound.

    Raises ValueError as `compare`, and as `run_case`.
    """
    laws = with_hand_drawn(case, controllers)
    free = dataclasses.replace(case, controller=None)
    return [compare(*_changed(free, laws, run), period) for run in runs]


def with_hand_drawn(
    case: Case, controllers: Mapping[str, AbstractController]
) -> dict[str, AbstractController]:
    """The controllers and the law drawn by hand, where the case allows one."""
    sampled = [one for one in controllers.values() if one.period is not None]
    periods = [float(concrete(one.period)) for one in sampled]
    delays = [0.0 if one.delay is None else float(concrete(one.delay)) for one in sampled]
    gates = [one.gates for one in sampled if getattr(one, "gates", None) is not None]
    numbers = {"period": min(periods, default=0.01), "delay": max(delays, default=0.0)}
    if gates:
        numbers["gates"] = tuple(concrete(gates[0]))
    return dict(controllers) | {HAND_DRAWN: hand_drawn_law(case, **numbers)}


def hand_drawn_peaks(case: Case, runs: Sequence[AddressValues]) -> Float[np.ndarray, " run"] | None:
    """Largest deflections (m) at the sensors under the law drawn by hand, by run.

    None for a case that allows no such law: without loads, say, or with ones that stand.
    """
    laws = {} if case.controller is None else {"its own": case.controller}
    free = dataclasses.replace(case, controller=None)
    try:
        law = with_hand_drawn(case, laws)[HAND_DRAWN]
        cases = [_changed(free, {HAND_DRAWN: law}, run) for run in runs]
        for one, controllers in cases:
            check_case(dataclasses.replace(one, controller=controllers[HAND_DRAWN]))
    except ValueError:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        records = [
            simulate(dataclasses.replace(one, controller=controllers[HAND_DRAWN]))
            for one, controllers in cases
        ]
    return np.array([float(np.max(record.peak_deflection)) for record in records])


def hand_drawn_sentence(outcome: RunSetResult, peaks: Float[np.ndarray, " run"]) -> str:
    """Sentence on the peaks (m) under the law drawn by hand in the runs of a tuning."""
    reductions = 1 - peaks / outcome.uncontrolled_peaks
    return (
        f"drawn by hand, with no number tuned: worst {outcome.name} run: peak"
        f" {against_no_control(reductions.min())}{outcome.attained_words(peaks)}"
    )


def _changed(case: Case, laws, run: AddressValues) -> tuple[Case, dict[str, AbstractController]]:
    """Case of a run, and the laws designed for the case as it is, with the settings of the run."""
    others = {a: value for a, value in run.items() if not a.startswith(OF_CONTROLLER)}
    settings = {a.removeprefix(OF_CONTROLLER): run[a] for a in run if a not in others}
    changed = run_case(case, others)
    nominal = {a: value_at(case, a) for a in others if a.startswith(PLANT_PREFIXES)}
    layout = mesh_layout(changed)
    controllers = {}
    for name, law in laws.items():
        one = _with_settings(dataclasses.replace(changed, controller=law), settings)
        controllers[name] = with_fixed_design(one, nominal, layout).controller
    return changed, controllers


def _with_settings(case: Case, settings: Mapping[str, float]) -> Case:
    """The case with settings of its controller; of those it lacks, delays alone are given to it."""
    law = case.controller
    for key, value in settings.items():
        name = key.split(".")[0]
        if key == "delay":
            case = dataclasses.replace(case, controller=dataclasses.replace(law, delay=value))
        elif getattr(law, name, None) is not None:
            case = replace(case, {f"{OF_CONTROLLER}{key}": np.asarray(value)})
        law = case.controller
    return case
