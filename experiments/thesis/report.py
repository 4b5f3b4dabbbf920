"""Reports on runs of thesis experiments: text for the terminal, sections for Markdown and HTML."""

from collections.abc import Sequence

import numpy as np

from experiments.thesis.verdicts import IRREPRODUCIBLE, VERDICTS, Finding, FindingVerdicts, Run
from jaxbeam.files.report import ReportFigure, ReportSection, ReportTable, text_table

COLUMNS = ("number", "published", "ours", "difference", "tolerance", "verdict")
PREFACE = (
    "The thesis's figures and measured curves are not available: comparisons are with printed"
    " numbers, and figures have the thesis's axes. Tolerances were chosen by the kind of number"
    " before the experiments were run, but for those by which numbers of Figs 6.4, 7.1 and 7.2, of"
    " Table 5.3 and printed sampled gains are judged, set after a first look; verdicts are computed"
    " from them."
)
REPORT_TITLE = "The thesis, reproduced"
VERDICT_STYLE = (
    ".reproduced { color: #00694c } .explained { color: #0072b2 } .not, .cannot { color: #b34700 }"
)


def count_verdicts(runs: Sequence[Run], verdict: str) -> int:
    """How many numbers got a verdict."""
    return sum(one.verdicts.count(verdict) for run in runs for one in run.judged)


def text(run: Run) -> str:
    """One experiment for the terminal."""
    lines = [f"{run.experiment.name}: {run.experiment.covers}", f"  {run.experiment.claim}"]
    for one, judged in zip(run.outcome.findings, run.judged, strict=True):
        lines += ["", f"  {_finding_title(one)}"]
        lines += [f"    {line}" for line in text_table(COLUMNS, _finding_rows(one, judged))]
        lines += [f"    {sentence}" for sentence in _finding_notes(one, judged.verdicts)]
    lines += [f"  {remark}" for remark in run.outcome.remarks]
    tally = ", ".join(f"{number} {word}" for word, number in _verdict_counts([run]) if number)
    tally = tally or "nothing printed to compare with"
    return "\n".join([*lines, "", f"  {tally}; {run.seconds:.0f} s", ""])


def report_sections(runs: Sequence[Run]) -> list[ReportSection]:
    """Sections of the report: a summary of all verdicts, then the experiments one by one."""
    sections = [ReportSection("", [PREFACE, _summary(runs)])]
    for run in runs:
        title = f"{run.experiment.name}: {run.experiment.covers}"
        sections.append(ReportSection(title, [run.experiment.claim]))
        for one, judged in zip(run.outcome.findings, run.judged, strict=True):
            table = ReportTable(COLUMNS, _finding_rows(one, judged), _verdict_class)
            notes = _finding_notes(one, judged.verdicts)
            sections.append(ReportSection(_finding_title(one), [table, *notes], level=4))
        figures = [ReportFigure(f"{run.experiment.name}-{name}") for name in run.outcome.figures]
        sections.append(ReportSection("", [*run.outcome.remarks, *figures]))
    return sections


def _finding_title(one: Finding) -> str:
    printed = one.published
    unit = "" if printed.unit in ("", "1") else f", {printed.unit}"
    return f"{printed.location}: {printed.quantity}{unit} ({printed.origin})"


def _finding_rows(one: Finding, judged: FindingVerdicts) -> list[tuple[str, ...]]:
    """One row for each number: ours is that of the reading which the verdict rests on."""
    rows = []
    columns = (
        one.published.value_labels,
        one.published.printed_text.split(),
        judged.verdicts,
        judged.interpretations,
    )
    for i, (label, published, word, reading) in enumerate(zip(*columns, strict=True)):
        ours = float(one.interpretations[reading][i])
        shown, difference = f"{ours:.6g}", f"{ours - float(published):+.2g}"
        if np.isnan(ours):
            shown = difference = "\N{EM DASH}"
        allowed = str(one.published.tolerance)
        rows.append((label.replace(",", ", "), published, shown, difference, allowed, word))
    return rows


def _finding_notes(one: Finding, verdicts: Sequence[str]) -> list[str]:
    """What further readings give, and why numbers cannot be reproduced."""
    sentences = (
        [f"Reading: {one.published.interpretation}."] if one.published.interpretation else []
    )
    if len(one.interpretations) > 1:
        for name, values in one.interpretations.items():
            numbers = " ".join(f"{value:.5g}" for value in np.asarray(values))
            hits = int(one.within_tolerance(name).sum())
            sentences.append(f"{name}: {numbers} ({hits} of {len(verdicts)} within the tolerance)")
    if IRREPRODUCIBLE in verdicts:
        sentences.append(f"Cannot be reproduced because {one.inconsistency}.")
    return sentences


def _verdict_counts(runs: Sequence[Run]) -> list[tuple[str, int]]:
    return [(word, count_verdicts(runs, word)) for word in VERDICTS]


def _summary(runs: Sequence[Run]) -> ReportTable:
    """Table of how many numbers got which verdict."""
    header = ("experiment", "numbers", *VERDICTS, "seconds")
    rows = [_summary_row(run.experiment.name, [run], run.seconds) for run in runs]
    total = _summary_row("all", runs, sum(run.seconds for run in runs))
    return ReportTable(header, [*rows, total], _verdict_class)


def _summary_row(name, runs, seconds) -> tuple[str, ...]:
    numbers = [number for _, number in _verdict_counts(runs)]
    return (name, str(sum(numbers)), *map(str, numbers), f"{seconds:.0f}")


def _verdict_class(cell: str) -> str | None:
    """The style of a verdict."""
    return cell.split()[0] if cell in VERDICTS else None
