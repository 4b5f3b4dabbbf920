"""Table of the numbers that modal identification chooses: value, meaning, and where each is from.

They stand in the code beside what they decide, with a comment; the table is printed from there for
the page on methods (`docs/explanation/modal.md`).
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOM = Path(__file__).parents[2] / "tuning" / "modal"
# The first that a name and its comment match.
SOURCES = {
    r"\b(1[89]|20)\d\d\b": "literature",
    r"planted|\blogs\b|records of|ambient vibration": "planted logs",
    r"PROBABILITY|CHANCE|SDS?\b|GAIN|UNLIKELY|QUANTILE|RAYLEIGH|_LOSS": "statistics",
    r"TOLERANCE|CONVERGED|STEP|ITERATIONS|PIVOT|TRIES|PART_|WORK|ROUNDING|1e-\d\d": "numerics",
    r"ORDER|ROWS|BLOCKS|LAGS|SAMPLES|SEGMENTS|BINS|LINES|MAX_ADDED|MAX_TRIED|TAPERS": "resolution",
}
OTHERWISE = "judgement"
EXPLAINED = """Each number stands in the code beside what it decides. Where it is from is sorted by
words of its name and comment, not by a record of how it was found: *literature*; *statistics*, as
probabilities of false alarms; *planted logs*, which the comment names; *resolution* and *numerics*,
sizes and tolerances; *judgement*, all others, chosen by hand without a derivation."""


class Constant(NamedTuple):
    """A number of the code: file, name, value as written, meaning and source."""

    file: str
    name: str
    value: str
    meaning: str
    source: str


def constants() -> Iterator[Constant]:
    """Constants of modules of `tuning.modal` that are numbers, file by file."""
    for path in sorted(set(ROOM.rglob("*.py")) - {ROOM / "plot.py"}):
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines()
        for node in ast.parse(text).body:
            if not isinstance(node, ast.Assign) or not _has_number(node.value):
                continue
            names = ast.unparse(node.targets[0]).strip("()")
            if not names.isupper():
                continue
            value = ast.unparse(node.value)
            meaning = _meaning(lines, node.lineno - 1, node.end_lineno or node.lineno)
            file = str(path.relative_to(ROOM))
            yield Constant(file, names, value, meaning, _source(f"{names} {value} {meaning}"))


def _has_number(node: ast.expr) -> bool:
    return any(
        isinstance(one, ast.Constant) and isinstance(one.value, int | float)
        for one in ast.walk(node)
    )


def _meaning(lines: list[str], first: int, last: int) -> str:
    """The comment beside a constant, and those in the lines above it."""
    above, inside = [], first
    while first and lines[first - 1].startswith("#"):
        first -= 1
        above.insert(0, lines[first].lstrip("# "))
    beside = [line.split("#")[1].strip() for line in lines[inside:last] if "#" in line]
    return " ".join([*above, *beside])


def _source(text: str) -> str:
    return next((word for pattern, word in SOURCES.items() if re.search(pattern, text)), OTHERWISE)


def table() -> str:
    """The table in Markdown."""
    rows = [
        f"| `{one.name}` | {one.value} | {one.meaning} | {one.source} | `{one.file}` |"
        for one in constants()
    ]
    head = ["| name | value | meaning | from | file |", "| --- | --- | --- | --- | --- |"]
    return "\n".join([*head, *rows])
