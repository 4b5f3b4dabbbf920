"""Runs of experiments as text, Markdown and HTML: one account, three dresses."""

import html as escaping
from collections.abc import Sequence

import numpy as np

from experiments.thesis.verdicts import IMPOSSIBLE, VERDICTS, Finding, Judged, Run
from jaxbeam.files.report import html_table, markdown_table, page

HEADER = ("number", "published", "ours", "difference", "tolerance", "verdict")
MEASURED = (
    "The thesis's figures and measured curves are not available: comparisons are with printed"
    " numbers, and figures have the thesis's axes. Tolerances were chosen by the kind of number"
    " before the experiments were run, but for those by which numbers of Figs 6.4, 7.1 and 7.2, of"
    " Table 5.3 and printed sampled gains are judged, set after a first look; verdicts are computed"
    " from them."
)
STYLE = (
    ".reproduced { color: #00694c } .explained { color: #0072b2 } .not, .cannot { color: #b34700 }"
)


def count(runs: Sequence[Run], word: str) -> int:
    """How many numbers got a verdict."""
    return sum(one.words.count(word) for run in runs for one in run.judged)


def text(run: Run) -> str:
    """One experiment for the terminal."""
    lines = [f"{run.experiment.name}: {run.experiment.covers}", f"  {run.experiment.claim}"]
    for one, judged in zip(run.outcome.findings, run.judged, strict=True):
        lines += ["", f"  {_title(one)}"]
        rows = [HEADER, *_rows(one, judged)]
        widths = [max(len(row[i]) for row in rows) for i in range(len(HEADER))]
        lines += ["    " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        lines += [f"    {sentence}" for sentence in _comments(one, judged.words)]
    lines += [f"  {remark}" for remark in run.outcome.remarks]
    tally = ", ".join(f"{number} {word}" for word, number in _tally([run]) if number)
    tally = tally or "nothing printed to compare with"
    return "\n".join([*lines, "", f"  {tally}; {run.seconds:.0f} s", ""])


def markdown(runs: Sequence[Run]) -> str:
    """The report in Markdown, figures beside it."""
    lines = ["# The thesis, reproduced", "", MEASURED, ""]
    lines += markdown_table(*_summary(runs))
    for run in runs:
        lines += [f"## {run.experiment.name}: {run.experiment.covers}", "", run.experiment.claim]
        for one, judged in zip(run.outcome.findings, run.judged, strict=True):
            lines += ["", f"**{_title(one)}**", "", *markdown_table(HEADER, _rows(one, judged))]
            lines += [f"{sentence}\n" for sentence in _comments(one, judged.words)]
        lines += ["", *(f"{remark}\n" for remark in run.outcome.remarks)]
        lines += [f"![{name}]({_picture(run, name)})\n" for name in run.outcome.figures]
    return "\n".join(lines)


def html(runs: Sequence[Run]) -> str:
    """The report as a page, figures beside it."""
    safe = escaping.escape
    parts = [
        f"<h1>The thesis, reproduced</h1><p>{MEASURED}</p>",
        html_table(*_summary(runs), _marked),
    ]
    for run in runs:
        title = safe(f"{run.experiment.name}: {run.experiment.covers}")
        parts.append(f"<h2>{title}</h2><p>{safe(run.experiment.claim)}</p>")
        for one, judged in zip(run.outcome.findings, run.judged, strict=True):
            parts.append(f"<h4>{safe(_title(one))}</h4>")
            parts.append(html_table(HEADER, _rows(one, judged), _marked))
            parts += [f"<p>{safe(sentence)}</p>" for sentence in _comments(one, judged.words)]
        parts += [f"<p>{safe(remark)}</p>" for remark in run.outcome.remarks]
        parts += [f'<img src="{_picture(run, n)}" alt="{safe(n)}">' for n in run.outcome.figures]
    return page("The thesis, reproduced", parts, STYLE)


def _title(one: Finding) -> str:
    printed = one.printed
    unit = "" if printed.unit in ("", "1") else f", {printed.unit}"
    return f"{printed.where}: {printed.what}{unit} ({printed.kind})"


def _rows(one: Finding, judged: Judged) -> list[tuple[str, ...]]:
    """One row for each number: ours is that of the reading which the verdict rests on."""
    rows = []
    columns = one.printed.names, one.printed.values.split(), judged.words, judged.by
    for i, (label, published, word, reading) in enumerate(zip(*columns, strict=True)):
        ours = float(one.readings[reading][i])
        shown, difference = f"{ours:.6g}", f"{ours - float(published):+.2g}"
        if np.isnan(ours):
            shown = difference = "\N{EM DASH}"
        allowed = str(one.printed.tolerance)
        rows.append((label.replace(",", ", "), published, shown, difference, allowed, word))
    return rows


def _comments(one: Finding, words: Sequence[str]) -> list[str]:
    """What further readings give, and why numbers cannot be reproduced."""
    sentences = [f"Reading: {one.printed.reading}."] if one.printed.reading else []
    if len(one.readings) > 1:
        for name, values in one.readings.items():
            numbers = " ".join(f"{value:.5g}" for value in np.asarray(values))
            hits = int(one.within(name).sum())
            sentences.append(f"{name}: {numbers} ({hits} of {len(words)} within the tolerance)")
    if IMPOSSIBLE in words:
        sentences.append(f"Cannot be reproduced because {one.obstacle}.")
    return sentences


def _tally(runs: Sequence[Run]) -> list[tuple[str, int]]:
    return [(word, count(runs, word)) for word in VERDICTS]


def _summary(runs: Sequence[Run]):
    """Header and rows of the table that says how many numbers got which verdict."""
    header = ("experiment", "numbers", *VERDICTS, "seconds")
    rows = [_counted(run.experiment.name, [run], run.seconds) for run in runs]
    return header, [*rows, _counted("all", runs, sum(run.seconds for run in runs))]


def _counted(name, runs, seconds) -> tuple[str, ...]:
    numbers = [number for _, number in _tally(runs)]
    return (name, str(sum(numbers)), *map(str, numbers), f"{seconds:.0f}")


def _picture(run: Run, name: str) -> str:
    return f"{run.experiment.name}-{name}.png"


def _marked(cell: str) -> str | None:
    """The style of a verdict."""
    return cell.split()[0] if cell in VERDICTS else None
