"""Assessment of a bridge by a code: its checks as text, Markdown and plain numbers."""

import dataclasses
import os
from typing import Any

from jaxbeam.analysis.assessment.train_effects import TrainEffects
from jaxbeam.files.report import text_table
from jaxbeam.runtime.whole_file import whole_file

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
class Assessment:
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
        """Effects for which trains govern the design in place of LM71: a finding, no failure."""
        return tuple(
            check.subject.partition(", ")[2]
            for check in self.checks
            if check.outcome == TRAINS_GOVERN
        )

    @property
    def verdict(self) -> str:
        """What the checks say together; never a certificate."""
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

    def _rows(self) -> list[list[str]]:
        return [
            [
                check.subject,
                "" if check.value is None else f"{check.value:.4g}",
                "" if check.limit is None else f"{check.limit:.4g}",
                "" if check.unit == "1" else check.unit,
                check.outcome,
                check.clause,
            ]
            for check in self.checks
        ]

    @property
    def _inputs(self) -> list[str]:
        return [f"{name}: {value}" for name, value in self.inputs.items()]

    @property
    def lines(self) -> list[str]:
        """Lines of the report as text."""
        remarks = [f"  {c.subject}: {c.remark}" for c in self.checks if c.remark]
        return [
            f"{self.title}, {self.code}",
            *(f"  {line}" for line in self._inputs),
            "",
            *text_table(HEADER, self._rows(), "<>><<<"),
            "",
            *remarks,
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
        effects = []
        if self.effects:
            effects = ["## Largest effects of each train", markdown_table(*self.effects.rows())]
        parts = [
            f"# {self.title}",
            f"Checks by {self.code}. {self.verdict}",
            "\n".join(f"- {line}" for line in self._inputs),
            markdown_table(HEADER, *self._rows()),
            "\n".join(f"- {c.subject}: {c.remark}" for c in self.checks if c.remark),
            *effects,
            "## Not checked",
            "\n".join(f"- {item}" for item in self.not_checked),
            "## Not in the model, hence not certified",
            "\n".join(f"- {item}" for item in self.not_in_model),
            "## Sources of the numbers",
            "\n".join(f"- {clause}: {source}" for clause, source in self.sources.items()),
        ]
        return "\n\n".join(part for part in parts if part) + "\n"

    def plot(self, **options):
        """Figure of the effects over speed with limit lines; see `jaxbeam.plot.plot_assessment`."""
        from jaxbeam.plot import plot_assessment

        return plot_assessment(self, **options)

    def save(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write the report as Markdown. Raises FileExistsError unless `overwrite`."""
        with whole_file(path, overwrite) as beside:
            beside.write_text(self.to_markdown(), encoding="utf-8")


def markdown_table(head: list[str], *rows: list[str]) -> str:
    """A table in Markdown."""
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows))


HEADER = ["check", "value", "limit", "unit", "outcome", "clause"]
