"""Counts of verdicts, and tables of results, on the pages of the documentation.

    python -m experiments.thesis.page out/reproduce/report.json

writes docs/explanation/thesis.md, the tables and the shares of docs/explanation/results.md, and the
sentence between the marks of docs/howto/reproduce.md. Run it after `jaxbeam reproduce --all`. The
remarks of its experiments `tuned`, `sensed` and `fragile` have the numbers of the tables.
"""

import json
import re
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments.thesis.report import ALL_VERDICTS
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
RESULTS = ROOT / "docs" / "explanation" / "results.md"
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


SHARES = re.compile(r"(.+): at least (-?[\d.]+)% of the achievable, (-?[\d.]+)% in the mean")
# Words of the page for the laws and settings of the remarks, of one span and of two.
TUNED_ROWS = {
    "cubic feedback, as published": ("hand-set, cubic",),
    "trapezium drawn by hand, same gates and limits": ("hand-set trapezium",),
    "tuned table": ("tuned, bench",),
    "the same, 10 ms more delay than compensated": ("10 ms later",),
    "the same, beam 10 % stiffer": ("10 % stiffer",),
    "the same, beam 10 % softer": ("10 % softer",),
}
SENSED_ROWS = {
    "cubic feedback, as published": ("hand-set, cubic",),
    "table drawn by hand, sensors only": ("hand-drawn, sensors only",),
    "tuned, sensors only, as on the test rig": ("tuned, sensors only",),
    "the same, 10 ms more delay than modelled": ("10 ms later",),
    "the same, beam 10 % stiffer": ("10 % stiffer",),
    "the same, beam 10 % softer": ("10 % softer",),
    "the same, a command every 15 ms": ("15 ms, 10 Hz", "15 ms, 20 Hz"),
    "the same, the filter of the other rig": ("10 ms, 20 Hz", "10 ms, 10 Hz"),
}
FRAGILE_COLUMNS = {
    "trapezium": "hand-set trapezium",
    "tuned table": "tuned, bench",
    "confirmed": "tuned, bench, confirmed by a sensor",
    "drawn, sensors only": "hand-drawn, sensors only",
    "tuned, sensors only": "tuned, sensors only",
}
NO_GAIN = "worse than no control"
BEGIN_SHARES, END_SHARES = "<!-- shares of laws -->", "<!-- end of shares -->"


def shares_table(remarks: Sequence[str], rows: Mapping[str, tuple[str, ...]]) -> list[str]:
    """Lines of a table: shares of the attainable reduction of one and of two spans, worst (mean).

    Raises KeyError if the remarks lack a row.
    """
    rigs: list[dict[str, str]] = []
    for remark in remarks:
        if re.match(r"[A-Z]: ", remark):
            rigs.append({})
        elif found := SHARES.fullmatch(remark):
            worst, mean = float(found[2]), float(found[3])
            rigs[-1][found[1]] = f"{worst:.1f} % ({mean:.1f} %)" if worst >= 0 else NO_GAIN
    lines = ["| share of the attainable reduction, held out: worst (mean) | one span | two spans |"]
    lines += ["|---|---:|---:|"]
    for words, labels in rows.items():
        cells = [rig[label] for rig, label in zip(rigs, (labels[0], labels[-1]), strict=True)]
        lines.append(f"| {words} | {' | '.join(cells)} |")
    return lines


def fragile_table(remarks: Sequence[str]) -> list[str]:
    """Lines of a table: shares of the attainable reduction by changes, a column for each law."""
    lines = [f"| change | {' | '.join(FRAGILE_COLUMNS)} |"]
    lines += ["|---|" + "---:|" * len(FRAGILE_COLUMNS)]
    for remark in remarks:
        change, _, laws = remark.partition(": ")
        found = {
            label: re.search(rf"(?:^|, ){re.escape(label)} (-?[\d.]+)%", laws)
            for label in FRAGILE_COLUMNS.values()
        }
        if any(found.values()):
            shares = [float(one[1]) if one else None for one in found.values()]
            cells = ["" if s is None else f"{s:.1f} %" if s >= 0 else NO_GAIN for s in shares]
            lines.append(f"| {change} | {' | '.join(cells)} |")
    return lines


def with_tables(text: str, report: Mapping) -> str:
    """The page with the tables of a report between its marks, `<!-- tuned -->` and so on.

    Raises ValueError if a mark is missing, KeyError if the report lacks an experiment.
    """
    remarks = {name: one["remarks"] for name, one in report["experiments"].items()}
    tables = {
        "tuned": shares_table(remarks["tuned"], TUNED_ROWS),
        "sensed": shares_table(remarks["sensed"], SENSED_ROWS),
        "fragile": fragile_table(remarks["fragile"]),
    }
    for name, lines in tables.items():
        begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        before, found, rest = text.partition(begin)
        _, closed, after = rest.partition(end)
        if not (found and closed):
            raise ValueError(f"there are no marks {begin} and {end} in the text")
        text = "\n".join([before + begin, "", *lines, "", end + after])
    return text


def shares_paragraph(text: str) -> str:
    """First paragraph of the page on the laws, with numbers of its tables.

    Raises KeyError if the page lacks a row.
    """
    tables = {
        name: {
            cells[0]: cells[1:]
            for line in _between(text, f"<!-- {name} -->", f"<!-- end of {name} -->").splitlines()
            if (cells := [cell.strip() for cell in line.strip("| ").split("|")])
        }
        for name in ("tuned", "sensed", "fragile")
    }

    def worst(name: str, row: str) -> str:
        return " and ".join(cell.partition(" (")[0] for cell in tables[name][row])

    gates, hand, published = (worst("tuned", row) for row in list(TUNED_ROWS)[2::-1])
    drawn, sensors = (worst("sensed", row) for row in list(SENSED_ROWS)[1:3])
    light, fast = (tables["fragile"][change] for change in ("0.1 kg", "2 m/s"))
    other = tables["fragile"]["filter of the other rig"][-1]
    other = f"{'is' if other == NO_GAIN else 'attains'} {other}"
    return (
        "Tuned laws of the laboratory rigs, share of the attainable reduction of the peak on"
        f" held-out loads, at worst, of one and two spans: by two gates {gates}, drawn by hand (a"
        f" trapezium of four numbers) {hand}; by sensors alone {sensors}, drawn by hand {drawn};"
        f" cubic feedback as published {published}. They have limits: the law by gates attains"
        f" {light[1]} with a load of 0.1 kg and {fast[1]} at 2 m/s, the trapezium {light[0]} and"
        f" {fast[0]}; with the filter of the other rig the law by sensors of one span {other}."
    )


def with_shares(text: str) -> str:
    """The page with the paragraph on the laws between its marks, by its tables.

    Raises ValueError if it has no marks.
    """
    old = _between(text, BEGIN_SHARES, END_SHARES)
    return text.replace(old, f"\n{shares_paragraph(text)}\n")


def _between(text: str, begin: str, end: str) -> str:
    _, found, rest = text.partition(begin)
    inner, closed, _ = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"there are no marks {begin} and {end} in the text")
    return inner


def write(report: dict) -> None:
    """Write the page, the tables and shares of results, and the counts of `reproduce.md`."""
    PAGE.write_text(page(report), encoding="utf-8")
    results = with_tables(RESULTS.read_text(encoding="utf-8"), report)
    RESULTS.write_text(with_shares(results), encoding="utf-8")
    COUNTS.write_text(with_counts(COUNTS.read_text(encoding="utf-8"), report), encoding="utf-8")


if __name__ == "__main__":
    write(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
