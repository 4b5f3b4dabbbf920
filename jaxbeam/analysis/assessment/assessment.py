"""Result of an assessment, and the formulas of the code."""

import dataclasses
import functools
import os
import tomllib
from collections.abc import Iterable
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.display import text_scale
from jaxbeam.files.report import ReportSection, ReportTable, markdown
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.runtime.printer import TableViews, text_table


class TrainCurve(NamedTuple):
    """Largest absolute values of all effects under a train over its speeds (m/s).

    The factor for the state of the track is part of them.
    """

    train: str
    speeds: Float[np.ndarray, " speed"]
    values: Float[np.ndarray, "speed effect"]


class TrainEffects(NamedTuple):
    """Effects by name, with quantity, SI unit and limit of each, under some trains.

    Limits are that of the deck acceleration, and the effects of LM71 with its factors.
    """

    names: tuple[str, ...]
    quantities: tuple[str, ...]
    units: tuple[str, ...]
    limits: tuple[float, ...]
    curves: tuple[TrainCurve, ...]

    def largest(self) -> Float[np.ndarray, "train effect"]:
        """Largest values of the effects over the speeds of each train."""
        return np.stack([curve.values.max(axis=0) for curve in self.curves])

    def rows(self) -> list[list[str]]:
        """Rows of a table: head, then an effect each with its unit, limit and every train.

        Units have prefixes, as MN m.
        """
        rows = [["effect", "unit", "limit", *(curve.train for curve in self.curves)]]
        numbers = np.column_stack([self.limits, self.largest().T])
        for name, si_unit, row in zip(self.names, self.units, numbers, strict=True):
            factor, unit = text_scale(row, si_unit)
            rows.append([name, unit, *(f"{value / factor:.4g}" for value in row)])
        return rows

    @property
    def lines(self) -> list[str]:
        """The table as lines of text."""
        head, *rows = self.rows()
        return text_table(head, rows, "<<" + ">" * (len(head) - 2))

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and texts by name."""
        curves = [
            {"train": one.train, "speeds": one.speeds.tolist(), "values": one.values.tolist()}
            for one in self.curves
        ]
        return self._asdict() | {"curves": curves}


@functools.cache
def code_numbers() -> dict[str, Any]:
    """Numbers of the code by subject, with clause and source (see `en1991_2.toml`)."""
    text = (resources.files(__package__) / "en1991_2.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


class FrequencyLimits(NamedTuple):
    """Limits (Hz) of the first natural frequency n0, figure 6.10."""

    lower: Float[Array, "..."]
    upper: Float[Array, "..."]


def frequency_limits(length) -> FrequencyLimits:
    """Limits of n0 for a span or determinant length (m), up to 100 m: figure 6.10.

    n0 <= 94.76 L^-0.748; n0 >= 80 / L up to 20 m, 23.58 L^-0.592 beyond.
    """
    numbers = code_numbers()["frequency_limits"]
    (upper, upper_power), (lower, lower_power) = numbers["upper"], numbers["lower"]
    length = xp.asarray(length, float)
    short = length <= numbers["short_span"]
    return FrequencyLimits(
        xp.where(short, numbers["short_lower"] / length, lower * length**lower_power),
        upper * length**upper_power,
    )


def running_factor(speed, length, frequency) -> Float[Array, "..."]:
    """Dynamic increment phi' of a train on perfect track, annex C.

    phi' = K / (1 - K + K^4) with K = v / (2 L n0) up to 0.76, then 1.325; v in m/s, the determinant
    length L in m, n0 in Hz.
    """
    numbers = code_numbers()["annex_c"]
    K = xp.asarray(speed, float) / (2 * length * frequency)
    within = xp.minimum(K, numbers["largest_ratio"])
    beyond = numbers["largest_ratio"] < K
    return xp.where(beyond, numbers["limit"], within / (1 - within + within**4))


def irregularity_factor(speed, length, frequency) -> Float[Array, "..."]:
    """Dynamic increment phi'' from irregularities of the track, annex C; not below zero.

    phi'' = alpha / 100 (56 exp(-(L/10)^2) + 50 (n0 L / 80 - 1) exp(-(L/20)^2)), alpha = v / 22 up
    to 1; units as in `running_factor`.
    """
    numbers = code_numbers()["annex_c"]
    alpha = xp.minimum(xp.asarray(speed, float) / numbers["reference_speed"], 1.0)
    (short, long), (first, second) = numbers["lengths"], numbers["factors"]
    length = xp.asarray(length, float)
    relative = length * frequency / numbers["frequency_length"] - 1
    percent = first * xp.exp(-((length / short) ** 2))
    percent = percent + second * relative * xp.exp(-((length / long) ** 2))
    return xp.maximum(alpha / 100 * percent, 0.0)


def track_factor(speed, length, frequency, track: str) -> Float[Array, "..."]:
    """Factor of calculated dynamic effects for the state of the track: 1 + phi'' or 1 + phi''/2.

    The whole phi'' for a "standard" track, half of it for one carefully "maintained"; units as in
    `running_factor`.
    """
    part = code_numbers()["dynamic_factors"][track]["track_irregularity"]
    return 1 + part * irregularity_factor(speed, length, frequency)


def static_dynamic_factor(length, track: str) -> Float[Array, "..."]:
    """Dynamic factor Phi_2 (carefully "maintained" track) or Phi_3 ("standard") of LM71, 6.4.5.2.

    The determinant length is in m.
    """
    numbers = code_numbers()["dynamic_factors"][track]
    factor = numbers["a"] / (xp.sqrt(xp.asarray(length, float)) - 0.2) + numbers["b"]
    return xp.clip(factor, *numbers["limits"])


SATISFIED, NOT_SATISFIED, INFORMATION = "satisfied", "not satisfied", "information"
REQUIRED, NOT_REQUIRED = "required", "not required"
TRAINS_GOVERN, LM71_GOVERNS = "trains govern", "LM71 governs"


@dataclasses.dataclass(frozen=True)
class CodeCheck:
    """One check: what is compared with which limit, by which clause, and the outcome.

    `value` and `limit` are in `unit` (None where there is none); `remark` has the other numbers.

    >>> import jaxbeam as jb
    >>> bridge = jb.Case(jb.Beam(25.0, 3e10, 15000.0, damping_ratio=0.01))
    >>> check = jb.assess(bridge, "160 km/h").checks[0]
    >>> print(check.subject, f"{check.value:.2f} {check.unit},", check.outcome)
    first natural frequency n0 3.55 Hz, information
    """

    subject: str
    clause: str
    value: float | None
    limit: float | None
    unit: str
    outcome: str
    remark: str = ""


@dataclasses.dataclass(frozen=True)
class Assessment(TableViews):
    """Checks of a bridge by a code, its inputs, and what is not checked and not in the model.

    `sources` are the open sources of the numbers of the code by clause, `effects` those of the
    trains over speed, if a dynamic analysis was made.

    >>> import jaxbeam as jb
    >>> bridge = jb.Case(jb.Beam(25.0, 3e10, 15000.0, damping_ratio=0.01))
    >>> found = jb.assess(bridge, "160 km/h")
    >>> print(len(found.checks), "checks,", len(found.failed), "not satisfied")
    5 checks, 0 not satisfied
    """

    title: str
    code: str
    inputs: dict[str, Any]
    checks: tuple[CodeCheck, ...]
    not_checked: tuple[str, ...]
    not_in_model: tuple[str, ...]
    sources: dict[str, str]
    effects: TrainEffects | None = None

    @property
    def failed(self) -> tuple[CodeCheck, ...]:
        """Checks that are not satisfied."""
        return tuple(check for check in self.checks if check.outcome == NOT_SATISFIED)

    @property
    def governed_by_trains(self) -> tuple[str, ...]:
        """Names of effects for which trains govern the design in place of LM71, no failure."""
        return tuple(
            check.subject.partition(", ")[2]
            for check in self.checks
            if check.outcome == TRAINS_GOVERN
        )

    @property
    def verdict(self) -> str:
        """Sentence that sums up the checks; never a certificate."""
        if self.failed:
            subjects = ", ".join(check.subject for check in self.failed)
            found = f"not satisfied: {subjects}"
        else:
            found = "the checks made are satisfied"
        if self.governed_by_trains:
            found += f"; the trains govern the design of {', '.join(self.governed_by_trains)}"
        return (
            f"{found}. This is no certificate: what is listed as not checked and not in the model"
            " remains to be shown."
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and texts by name."""
        content = dataclasses.asdict(dataclasses.replace(self, effects=None))
        effects = None if self.effects is None else self.effects.to_dict()
        return content | {"effects": effects, "verdict": self.verdict}

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Subject, value, limit, unit, outcome and clause of each check, by head.

        Values and limits that a check lacks are NaN.
        """
        numbers = np.array([(c.value, c.limit) for c in self.checks], float).reshape(-1, 2)
        units = ["" if check.unit == "1" else check.unit for check in self.checks]
        outcomes, clauses = ([getattr(c, key) for c in self.checks] for key in HEADER[4:])
        columns = [c.subject for c in self.checks], *numbers.T, units, outcomes, clauses
        return dict(zip(HEADER, map(np.asarray, columns), strict=True))

    @property
    def remarks(self) -> list[str]:
        """Remarks on checks, a sentence each with its subject."""
        return [f"{check.subject}: {check.remark}" for check in self.checks if check.remark]

    def _rows(self) -> list[list[str]]:
        rows = []
        for check in self.checks:
            numbers = [one for one in (check.value, check.limit) if one is not None]
            factor, unit = text_scale(numbers, check.unit)
            texts = [f"{one / factor:.4g}" for one in numbers] + [""] * (2 - len(numbers))
            rows.append([check.subject, *texts, unit, check.outcome, check.clause])
        return rows

    @property
    def _inputs(self) -> list[str]:
        return [f"{name}: {value}" for name, value in self.inputs.items()]

    @property
    def lines(self) -> list[str]:
        """Lines of the report as text."""
        return [
            f"{self.title}, {self.code}",
            *(f"  {line}" for line in self._inputs),
            "",
            *text_table(HEADER, self._rows(), "<>><<<"),
            "",
            *(f"  {remark}" for remark in self.remarks),
            "",
            *(["largest effects of each train:", *self.effects.lines, ""] if self.effects else []),
            "not checked:",
            *(f"  {item}" for item in self.not_checked),
            "not in the model, hence not certified:",
            *(f"  {item}" for item in self.not_in_model),
            "",
            f"verdict: {self.verdict}",
        ]

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def to_markdown(self) -> str:
        """The report as Markdown, with the sources of the numbers of the code."""
        inputs = _listed(self._inputs)
        sections = [
            ReportSection(
                "",
                [
                    f"Checks by {self.code}. {self.verdict}",
                    *inputs,
                    ReportTable(HEADER, self._rows()),
                    *_listed(self.remarks),
                ],
            )
        ]
        if self.effects:
            head, *rows = self.effects.rows()
            title = "Largest effects of each train"
            sections.append(ReportSection(title, [ReportTable(head, rows)]))
        sources = (f"{clause}: {source}" for clause, source in self.sources.items())
        for title, items in (
            ("Not checked", self.not_checked),
            ("Not in the model, hence not certified", self.not_in_model),
            ("Sources of the numbers", sources),
        ):
            sections.append(ReportSection(title, _listed(items)))
        return markdown(self.title, sections)

    def plot(self, **options):
        """Figure of the effects over speed with limit lines; see `jaxbeam.plot.plot_assessment`."""
        from jaxbeam.plot import plot_assessment

        return plot_assessment(self, **options)

    def save(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write the report as Markdown. Raises FileExistsError unless `overwrite`."""
        with whole_file(path, overwrite) as partial:
            partial.write_text(self.to_markdown(), encoding="utf-8")


def _listed(items: Iterable[str]) -> list[str]:
    """A list in Markdown, or nothing without items."""
    text = "\n".join(f"- {item}" for item in items)
    return [text] if text else []


HEADER = ["check", "value", "limit", "unit", "outcome", "clause"]
