"""Tables of measured or computed numbers on pages are printed by code, none is typed."""

import re

import pytest

from experiments.benchmarks.__main__ import BENCHMARKS
from tests.modules import ROOT

# Pages whose tables have numbers in the source, and why.
WRITTEN = {
    "docs/explanation/thesis.md": "written by `experiments.thesis.page`",
    "docs/explanation/thesis_changes.md": "a history: verdicts before and after new rules",
}
GENERATED = ("docs/_static/", "docs/reference/api/", "docs/reference/case_file/")
GENERATED = (*GENERATED, "docs/reference/commands.md", "docs/reference/modal_constants.md")
CODE = re.compile(r"^(```+|:::+).*?^\1", re.M | re.S)
MARKED = re.compile(r"<!-- ([\w ]+) -->.*?<!-- end of [\w ]+ -->", re.S)  # written by code
# A cell that is a number, with a unit perhaps; the unit 1 is none.
NUMBER = re.compile(
    r"(?!1$)[<>±-]?\d+(\.\d+)?(e-?\d+)?( ?(%|s|ms|us|µs|MiB|mm|m|Hz|N|times|core hours))?( \(.*\))?"
)
PAGES = [
    page
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if not page.relative_to(ROOT).as_posix().startswith(GENERATED)
]


def number_rows(text: str) -> list[str]:
    """Rows of tables outside code and marks in which a cell is a number."""
    rows = [line for line in MARKED.sub("", CODE.sub("", text)).splitlines() if line[:1] == "|"]
    return [
        row for row in rows if any(NUMBER.fullmatch(cell.strip()) for cell in row.split("|")[2:])
    ]


def test_tables_of_numbers_are_not_typed():
    assert number_rows("| a | 0.05 s |") and not number_rows("```\n| a | 0.05 s |\n```")
    found = {
        page.relative_to(ROOT).as_posix() for page in PAGES if number_rows(page.read_text("utf-8"))
    }
    assert found == set(WRITTEN)


INCLUDED = sorted((ROOT / "docs" / "_static" / "benchmarks").glob("*.md"))


@pytest.mark.parametrize("path", INCLUDED, ids=lambda path: path.stem)
def test_tables_of_benchmarks_are_as_printed(path):
    """They name machine and day, as `--pages` writes them, and a page includes them."""
    text = path.read_text("utf-8")
    assert path.stem in BENCHMARKS
    assert re.match(r"\d+ cores, (load [\d.]+, )?\d{4}-\d\d-\d\d:\n\n", text), text[:80]
    assert any(f"_static/benchmarks/{path.name}" in page.read_text("utf-8") for page in PAGES)
