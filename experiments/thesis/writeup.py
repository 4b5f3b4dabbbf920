"""Runs of experiments as text, Markdown and HTML: one account, three dresses."""

import html as escaping
from collections.abc import Sequence

import numpy as np

from experiments.thesis.verdicts import IRREPRODUCIBLE, VERDICTS, Finding, FindingVerdicts, Run
from jaxbeam.files.report import html_table, markdown_table, page

COLUMNS = ("number", "published", "ours", "difference", "tolerance", "verdict")
PREFACE = (
    "The thesis's figures and measured curves are not available: comparisons are with printed"
    " numbers, and figures have the thesis's axes. Tolerances were chosen by the kind of number"
    " before the experiments were run, but for those by which numbers of Figs 6.4, 7.1 and 7.2, of"
    " Table 5.3 and printed sampled gains are judged, set after a first look; verdicts are computed"
    " from them."
)
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
        rows = [COLUMNS, *_finding_rows(one, judged)]
        widths = [max(len(row[i]) for row in rows) for i in range(len(COLUMNS))]
        lines += ["    " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        lines += [f"    {sentence}" for sentence in _finding_notes(one, judged.verdicts)]
    lines += [f"  {remark}" for remark in run.outcome.remarks]
    tally = ", ".join(f"{number} {word}" for word, number in _verdict_counts([run]) if number)
    tally = tally or "nothing printed to compare with"
    return "\n".join([*lines, "", f"  {tally}; {run.seconds:.0f} s", ""])


def markdown(runs: Sequence[Run]) -> str:
    """The report in Markdown, figures beside it."""
    lines = ["# The thesis, reproduced", "", PREFACE, ""]
    lines += markdown_table(*_summary(runs))
    for run in runs:
        lines += [f"## {run.experiment.name}: {run.experiment.covers}", "", run.experiment.claim]
        for one, judged in zip(run.outcome.findings, run.judged, strict=True):
            lines += [
                "",
                f"**{_finding_title(one)}**",
                "",
                *markdown_table(COLUMNS, _finding_rows(one, judged)),
            ]
            lines += [f"{sentence}\n" for sentence in _finding_notes(one, judged.verdicts)]
        lines += ["", *(f"{remark}\n" for remark in run.outcome.remarks)]
        lines += [f"![{name}]({_figure_file(run, name)})\n" for name in run.outcome.figures]
    return "\n".join(lines)


def html(runs: Sequence[Run]) -> str:
    """The report as a page, figures beside it."""
    safe = escaping.escape
    parts = [
        f"<h1>The thesis, reproduced</h1><p>{PREFACE}</p>",
        html_table(*_summary(runs), _verdict_class),
    ]
    for run in runs:
        title = safe(f"{run.experiment.name}: {run.experiment.covers}")
        parts.append(f"<h2>{title}</h2><p>{safe(run.experiment.claim)}</p>")
        for one, judged in zip(run.outcome.findings, run.judged, strict=True):
            parts.append(f"<h4>{safe(_finding_title(one))}</h4>")
            parts.append(html_table(COLUMNS, _finding_rows(one, judged), _verdict_class))
            parts += [
                f"<p>{safe(sentence)}</p>" for sentence in _finding_notes(one, judged.verdicts)
            ]
        parts += [f"<p>{safe(remark)}</p>" for remark in run.outcome.remarks]
        parts += [
            f'<img src="{_figure_file(run, n)}" alt="{safe(n)}">' for n in run.outcome.figures
        ]
    return page("The thesis, reproduced", parts, VERDICT_STYLE)


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


def _summary(runs: Sequence[Run]):
    """Header and rows of the table that says how many numbers got which verdict."""
    header = ("experiment", "numbers", *VERDICTS, "seconds")
    rows = [_summary_row(run.experiment.name, [run], run.seconds) for run in runs]
    return header, [*rows, _summary_row("all", runs, sum(run.seconds for run in runs))]


def _summary_row(name, runs, seconds) -> tuple[str, ...]:
    numbers = [number for _, number in _verdict_counts(runs)]
    return (name, str(sum(numbers)), *map(str, numbers), f"{seconds:.0f}")


def _figure_file(run: Run, name: str) -> str:
    return f"{run.experiment.name}-{name}.png"


def _verdict_class(cell: str) -> str | None:
    """The style of a verdict."""
    return cell.split()[0] if cell in VERDICTS else None
