"""Counts of verdicts on the pages of the documentation, written from a report of `reproduce`.

    python -m experiments.thesis.page out/reproduce/report.json

writes docs/explanation/thesis.md, the tables and the shares of docs/explanation/results.md, and the
sentence between the marks of docs/howto/reproduce.md. Run it after `jaxbeam reproduce --all`.
"""

import json
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.thesis.report import ALL_VERDICTS
from experiments.thesis.results_tables import PAGE as RESULTS, with_shares, with_tables
from experiments.thesis.verdicts import (
    EXPLAINED,
    FITTED,
    INCONSISTENT,
    IRREPRODUCIBLE,
    NOT_REPRODUCED,
    NULL_MET,
    REPEATED,
    REPRODUCED,
    STATEMENT,
    VERDICTS,
)
from jaxbeam.runtime.printer import markdown_table

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "explanation" / "thesis.md"
COUNTS = ROOT / "docs" / "howto" / "reproduce.md"
BEGIN, END = "<!-- counts of verdicts -->", "<!-- end of counts -->"
INTRODUCTION = """# The numbers of the thesis, and which are reproduced

Each number in the thesis that can be computed has a verdict:

- *reproduced*: it follows from printed parameters to a unit of its last digit, their rounding
  included; a measured one within twice the noise of the sensors (section 5.1);
- *explained*: another reading of the text gives it, to which no parameter was fitted: that of its
  rig and chapter, listed below;
- *cannot be right*, or together with others *cannot all be right*: by a proof that is shown;
- else *not reproduced*.

A number counts for nothing if a null model (no control, static, one mode) meets it as well, if a
parameter was fitted to it, if it repeats another, or if it is a yes or a no.

The number of the thesis comes first, the computed one in brackets, then the reason. The report of
`jaxbeam reproduce --all`, from which `python -m experiments.thesis.page` writes this page, has all
readings, and those that count for nothing. Parameters that are not printed can be
[identified](../tutorials/notebooks/13_read_a_thesis).
"""


def findings(report: dict) -> Iterator[tuple[str, dict]]:
    """Name of the experiment and finding, for all findings of a report."""
    for name, experiment in report["experiments"].items():
        yield from ((name, one) for one in experiment["findings"])


def counts(report: dict) -> Counter:
    """Published numbers by verdict."""
    return Counter(verdict for _, one in findings(report) for verdict in one["verdicts"])


def sentence(report: dict) -> str:
    """The counts in a sentence."""
    found = counts(report)
    counted = sum(found[word] for word in VERDICTS)
    return (
        f"Of the {sum(found.values())} numbers of the thesis that can be computed {counted} count:"
        f" {found[REPRODUCED]} are reproduced, {found[EXPLAINED]} are explained by a named reading,"
        f" {found[IRREPRODUCIBLE]} cannot be right, {found[INCONSISTENT]} cannot all be right and"
        f" {found[NOT_REPRODUCED]} are not reproduced."
        f" The others count for nothing: a null model meets {found[NULL_MET]} of them as well,"
        f" a parameter was fitted to {found[FITTED]}, {found[REPEATED]} repeat others or are"
        f" arithmetic, and {found[STATEMENT]} are a yes or a no."
    )


def page(report: dict) -> str:
    """The page on the thesis: counts, then each number that counts and is not reproduced."""
    header = ("experiment", *ALL_VERDICTS)
    rows = []
    for name, experiment in report["experiments"].items():
        own = Counter(word for one in experiment["findings"] for word in one["verdicts"])
        if own:
            rows.append((name, *(str(own[word]) for word in ALL_VERDICTS)))
    rows.append(("all", *(str(counts(report)[word]) for word in ALL_VERDICTS)))
    readings = {one["rig"]: one["reading of the rig"] for _, one in findings(report)}
    parts = [INTRODUCTION, sentence(report), "", *markdown_table(header, rows, right_from=1)]
    parts += ["## Reading of each rig", "", *(f"- {rig}: {its}." for rig, its in readings.items())]
    parts += [""]
    for verdict in VERDICTS[1:]:
        lines = [_line(one, verdict) for _, one in findings(report) if verdict in one["verdicts"]]
        if lines:
            parts += [f"## {verdict[0].upper()}{verdict[1:]}", "", *lines, ""]
    return "\n".join(parts).rstrip() + "\n"


def _line(one: dict, verdict: str) -> str:
    """An item on the numbers of a finding with a verdict: printed, computed, and why."""
    which = [i for i, word in enumerate(one["verdicts"]) if word == verdict]
    computed = one["readings"][one["reading"]]
    pairs = ", ".join(
        f"{one['published'][i]:g}" + ("" if np.isnan(computed[i]) else f" ({computed[i]:.4g})")
        for i in which
    )
    reasons = {
        EXPLAINED: "",
        IRREPRODUCIBLE: one["impossible because"],
        INCONSISTENT: one["inconsistent because"],
        NOT_REPRODUCED: one["remark"],
    }
    reason = reasons[verdict]
    return f"- {one['where']}, {one['what']}: {pairs}" + (f": {reason}." if reason else ".")


def with_counts(text: str, report: dict) -> str:
    """The text with the sentence of the counts between its marks.

    Raises ValueError if it has no marks.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"there are no marks {BEGIN} and {END} in the text")
    return f"{before}{BEGIN}\n{sentence(report)}\n{END}{after}"


def write(report: dict) -> None:
    """Write the page, the tables and shares of results, and the counts of `reproduce.md`."""
    PAGE.write_text(page(report), encoding="utf-8")
    results = with_tables(RESULTS.read_text(encoding="utf-8"), report)
    RESULTS.write_text(with_shares(results), encoding="utf-8")
    COUNTS.write_text(with_counts(COUNTS.read_text(encoding="utf-8"), report), encoding="utf-8")


if __name__ == "__main__":
    write(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
