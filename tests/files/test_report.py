"""Reports in Markdown, HTML and plain text, and the files written."""

import pytest
from matplotlib.figure import Figure

from jaxbeam.files.report import (
    ReportFigure,
    ReportSection,
    ReportTable,
    check_report_folder,
    html,
    markdown,
    text_table,
    write_report,
)

TABLE = ReportTable(("load", "peak"), [("1 < 2", "good"), ("3", "bad")], {"good": "green"}.get)
SECTIONS = [
    ReportSection("", ["Preface & more."]),
    ReportSection("Peaks", [TABLE], level=3),
    ReportSection("Figure", [ReportFigure("drawn", Figure()), ReportFigure("elsewhere")]),
]


def test_markdown():
    assert markdown("Title", SECTIONS) == "\n".join(
        [
            "# Title", "", "Preface & more.", "", "### Peaks", "", "| load | peak |",
            "| --- | --- |", "| 1 < 2 | good |", "| 3 | bad |", "", "## Figure", "",
            "![drawn](drawn.png)", "", "![elsewhere](elsewhere.png)", "",
        ]
    )  # fmt: skip


def test_html_escapes_words_and_gives_cells_their_class():
    page = html("Title & co", SECTIONS, ".green { color: green }")
    assert "<h1>Title &amp; co</h1><p>Preface &amp; more.</p><h3>Peaks</h3>" in page
    assert '<tr><td>1 &lt; 2</td><td class="green">good</td></tr>' in page
    assert '<img src="drawn.png" alt="drawn">' in page and ".green { color: green }" in page


def test_only_figures_that_are_given_are_saved(tmp_path):
    write_report(tmp_path / "new" / "report", "Title", SECTIONS)
    written = {path.name for path in (tmp_path / "new" / "report").iterdir()}
    assert written == {"report.md", "report.html", "drawn.png"}


def test_a_folder_with_files_is_kept(tmp_path):
    (tmp_path / "other.txt").touch()
    with pytest.raises(FileExistsError, match="is not empty; choose another, or overwrite it"):
        write_report(tmp_path, "Title", SECTIONS)
    assert len(list(tmp_path.iterdir())) == 1
    check_report_folder(tmp_path, overwrite=True)
    check_report_folder(tmp_path / "none", overwrite=False)


def test_text_tables_are_aligned_column_by_column():
    rows = [("a", "1.5"), ("longer", "10")]
    assert text_table(("name", "m"), rows) == ["name    m", "a       1.5", "longer  10"]
    assert text_table(("name", "m"), rows, "<>")[1:] == ["a       1.5", "longer   10"]
