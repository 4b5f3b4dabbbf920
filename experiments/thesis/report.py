"""Report of experiments: published numbers beside computed ones, as text and as sections."""

from collections.abc import Sequence

import numpy as np

from experiments.thesis.verdicts import (
    IRREPRODUCIBLE,
    VERDICTS,
    ExperimentRun,
    Finding,
    FindingVerdicts,
)
from jaxbeam.files.report import ReportFigure, ReportSection, ReportTable, text_table

TITLE = "The thesis, reproduced"
COLUMNS = ("number", "published", "computed", "difference", "tolerance", "verdict")
METHOD = (
    "The thesis's figures and measured curves are not available: comparisons are with printed"
    " numbers, and figures have the thesis's axes. Tolerances depend on the kind of number and were"
    " fixed before the runs, except those of Figs 6.4, 7.1, 7.2, Table 5.3 and the sampled gains,"
    " set after a first look. Verdicts are computed from them."
)
VERDICT_STYLE = (
    ".reproduced { color: #00694c } .explained { color: #0072b2 } .not, .cannot { color: #b34700 }"
)


def as_text(run: ExperimentRun) -> str:
    """One experiment for the terminal."""
    lines = [f"{run.experiment.name}: {run.experiment.covers}", f"  {run.experiment.claim}"]
    for finding, assigned in zip(run.outcome.findings, run.verdicts, strict=True):
        lines += ["", f"  {_finding_title(finding)}"]
        lines += [f"    {line}" for line in text_table(COLUMNS, _finding_rows(finding, assigned))]
        lines += [f"    {sentence}" for sentence in _finding_notes(finding, assigned.verdicts)]
    lines += [f"  {remark}" for remark in run.outcome.remarks]
    counts = [f"{run.count(word)} {word}" for word in VERDICTS if run.count(word)]
    summary = ", ".join(counts) or "nothing printed to compare with"
    return "\n".join([*lines, "", f"  {summary}; {run.seconds:.0f} s", ""])


def sections(runs: Sequence[ExperimentRun]) -> list[ReportSection]:
    """The report of all experiments: method and summary, then each finding with its numbers."""
    report = [ReportSection("", [METHOD, _summary_table(runs)])]
    for run in runs:
        title = f"{run.experiment.name}: {run.experiment.covers}"
        report.append(ReportSection(title, [run.experiment.claim]))
        for finding, assigned in zip(run.outcome.findings, run.verdicts, strict=True):
            table = ReportTable(COLUMNS, _finding_rows(finding, assigned), _verdict_class)
            notes = _finding_notes(finding, assigned.verdicts)
            report.append(ReportSection(_finding_title(finding), [table, *notes], level=3))
        figures = [ReportFigure(figure_name(run, name)) for name in run.outcome.figures]
        report.append(ReportSection("", [*run.outcome.remarks, *figures]))
    return report


def figure_name(run: ExperimentRun, name: str) -> str:
    """Name of the file of a figure, without its suffix."""
    return f"{run.experiment.name}-{name}"


def _finding_title(finding: Finding) -> str:
    published = finding.published
    unit = "" if published.unit in ("", "1") else f", {published.unit}"
    return f"{published.location}: {published.quantity}{unit} ({published.origin})"


def _finding_rows(finding: Finding, assigned: FindingVerdicts) -> list[tuple[str, ...]]:
    """One row for each number; the computed one is by the interpretation of its verdict."""
    published = finding.published
    columns = (
        published.value_labels,
        published.printed_text.split(),
        assigned.verdicts,
        assigned.interpretations,
    )
    rows = []
    for i, (label, printed, verdict, interpretation) in enumerate(zip(*columns, strict=True)):
        value = float(finding.interpretations[interpretation][i])
        computed, difference = f"{value:.6g}", f"{value - float(printed):+.2g}"
        if np.isnan(value):
            computed = difference = "\N{EM DASH}"
        tolerance = str(published.tolerance)
        rows.append((label.replace(",", ", "), printed, computed, difference, tolerance, verdict))
    return rows


def _finding_notes(finding: Finding, verdicts: Sequence[str]) -> list[str]:
    """Sentences on the values by each interpretation, and why numbers cannot be reproduced."""
    published = finding.published
    sentences = []
    if published.interpretation:
        sentences.append(f"Interpretation: {published.interpretation}.")
    if len(finding.interpretations) > 1:
        for name, values in finding.interpretations.items():
            numbers = " ".join(f"{value:.5g}" for value in np.asarray(values))
            hits = int(finding.within_tolerance(name).sum())
            sentences.append(f"{name}: {numbers} ({hits} of {len(verdicts)} within the tolerance)")
    if IRREPRODUCIBLE in verdicts:
        sentences.append(f"Cannot be reproduced because {finding.inconsistency}.")
    return sentences


def _summary_table(runs: Sequence[ExperimentRun]) -> ReportTable:
    """Count of numbers by verdict, and wall time, for each experiment and for all."""

    def row(name: str, runs: Sequence[ExperimentRun]) -> tuple[str, ...]:
        counts = [sum(run.count(word) for run in runs) for word in VERDICTS]
        seconds = sum(run.seconds for run in runs)
        return (name, str(sum(counts)), *map(str, counts), f"{seconds:.0f}")

    rows = [row(run.experiment.name, [run]) for run in runs]
    header = ("experiment", "numbers", *VERDICTS, "seconds")
    return ReportTable(header, [*rows, row("all", runs)], _verdict_class)


def _verdict_class(cell: str) -> str | None:
    """CSS class of a cell with a verdict."""
    return cell.split()[0] if cell in VERDICTS else None
