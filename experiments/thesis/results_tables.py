"""Tables of the page on results, written from a report of `reproduce` between marks of the page.

The remarks of the experiments `tuned`, `sensed` and `fragile` have the numbers.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "results.md"
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
