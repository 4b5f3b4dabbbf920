"""Reports of sentences, tables and figures, as Markdown and HTML, and pages of interactive figures.

write_report(folder, "Crossing", [ReportSection("Peaks", ["Largest deflections.", table])])

An interactive figure, in which histories are zoomed and read off, draws by the scripts of `jaxbeam
app`, which its page contains, and asks nothing of any server.
"""

import base64
import html as html_library
import io
import json
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from jaxbeam.runtime.output_file import naming_file, whole_file
from jaxbeam.runtime.printer import Row, html_table, markdown_table

PAGE_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
       color: #22282e }
table { border-collapse: collapse; font-size: 0.85rem; margin: 1rem 0 }
th, td { text-align: left; padding: 0.2rem 0.8rem 0.2rem 0; border-bottom: 1px solid #dfe3e6 }
td { font-variant-numeric: tabular-nums }
img { max-width: 100% }
"""


class ReportTable(NamedTuple):
    """Table of a report; `cell_class` returns the CSS class of a cell's text, or None."""

    header: Row
    rows: Sequence[Row]
    cell_class: Callable[[str], str | None] = lambda cell: None


class ReportFigure(NamedTuple):
    """Figure of a report, in the file NAME.png beside it, or in the page itself if `embedded`.

    `figure` (matplotlib) is saved with the report; None if the file is written elsewhere.
    """

    name: str
    figure: Any = None
    embedded: bool = False

    def source(self) -> str:
        """Where a page finds the figure: a file, or its content in base 64."""
        if not self.embedded:
            return f"{self.name}.png"
        picture = io.BytesIO()
        self.figure.savefig(picture, format="png")
        return f"data:image/png;base64,{base64.b64encode(picture.getvalue()).decode()}"


class ReportSection(NamedTuple):
    """Heading of some level (2 to 6) and the paragraphs, tables and figures below it.

    Without a title the section has no heading.
    """

    title: str
    parts: Sequence[str | ReportTable | ReportFigure]
    level: int = 2


def check_report_folder(folder: str | os.PathLike, overwrite: bool) -> None:
    """Raises FileExistsError if it is a file, or not empty and `overwrite` is not set."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"{folder} is a file; a report is written to a folder")
    if folder.exists() and any(folder.iterdir()) and not overwrite:
        raise FileExistsError(f"the folder {folder} is not empty; choose another, or overwrite it")


def write_report(
    folder: str | os.PathLike,
    title: str,
    sections: Sequence[ReportSection],
    *,
    style: str = "",
    overwrite: bool = False,
) -> None:
    """Write report.md, report.html and the figures to a folder, which is made if need be.

    `style` (CSS) is added to `PAGE_STYLE`. Raises FileExistsError if the folder is not empty and
    `overwrite` is not set.
    """
    check_report_folder(folder, overwrite)
    folder = Path(folder)
    with naming_file(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for section in sections:
        for part in section.parts:
            if isinstance(part, ReportFigure) and part.figure is not None and not part.embedded:
                with whole_file(folder / f"{part.name}.png", overwrite) as partial:
                    part.figure.savefig(partial)
    pages = {"report.md": markdown(title, sections), "report.html": html(title, sections, style)}
    for name, text in pages.items():
        with whole_file(folder / name, overwrite) as partial:
            partial.write_text(text, encoding="utf-8")


def markdown(title: str, sections: Sequence[ReportSection]) -> str:
    """Text of a report in Markdown."""
    lines = [f"# {title}", ""]
    for section in sections:
        if section.title:
            lines += [f"{'#' * section.level} {section.title}", ""]
        for part in section.parts:
            if isinstance(part, ReportTable):
                lines += markdown_table(part.header, part.rows)
            elif isinstance(part, ReportFigure):
                lines += [f"![{part.name}]({part.source()})", ""]
            else:
                lines += [part, ""]
    return "\n".join(lines)


def html(title: str, sections: Sequence[ReportSection], style: str = "") -> str:
    """Text of a report as an HTML page; all words are escaped."""
    safe = html_library.escape
    body = [f"<h1>{safe(title)}</h1>"]
    for section in sections:
        if section.title:
            body.append(f"<h{section.level}>{safe(section.title)}</h{section.level}>")
        for part in section.parts:
            if isinstance(part, ReportTable):
                body.append(html_table(part.header, part.rows, cell_class=part.cell_class))
            elif isinstance(part, ReportFigure):
                body.append(f'<img src="{safe(part.source())}" alt="{safe(part.name)}">')
            else:
                body.append(f"<p>{safe(part)}</p>")
    head = f'<meta charset="utf-8"><title>{safe(title)}</title><style>{PAGE_STYLE}{style}</style>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(body)}</body></html>'


SCRIPTS = ("dom.js", "plot.js")
DIGITS = 6  # of a value
STYLE = (
    "body { display: block; height: auto; overflow: auto; padding: 8px } canvas { height: 220px }"
)
SHOW = """
const plots = [];
const all = (call) => plots.forEach(call);
for (const { title, unit, series } of DATA.panels) {
  const seek = (x) => all((plot) => plot.setCursor(x));
  const zoomed = (range) => all((plot) => plot.setZoom(range));
  const plot = new Plot({ title, unit, axis: DATA.axis, seek, zoomed });
  plots.push(plot);
  document.body.append(plot.element);
  plot.show({ x: DATA.x, series: series.map((one, i) => ({ ...one, tint: i })) });
}
"""


def interactive_page(title: str, sentence: str, columns: Mapping[str, Any]) -> str:
    """HTML page of columns over the first of them, a plot for each quantity with unit.

    The end of a head is its quantity: "midspan deflection (m)", "sensor 1 deflection (m)".
    """
    (axis, x), *others = columns.items()
    panels: dict[str, dict] = {}
    for head, values in others:
        name, quantity, unit = re.fullmatch(r"(.*?) ?(\S+)(?: \(([^()]*)\))?", head).groups()
        panel = panels.setdefault(
            f"{quantity} ({unit})", {"title": quantity, "unit": unit or "1", "series": []}
        )
        panel["series"].append({"name": name or quantity, "y": plain_numbers(values)})
    data = {"axis": axis, "x": plain_numbers(x), "panels": list(panels.values())}
    return page_of(title, sentence, SCRIPTS, data, SHOW)


def page_of(title: str, sentence: str, scripts: Sequence[str], data: Mapping, show: str) -> str:
    """HTML page of data (DATA), shown by the JavaScript `show` and by scripts of `jaxbeam app`."""
    folder = resources.files("jaxbeam.cli.page") / "static"
    texts = [(folder / name).read_text(encoding="utf-8") for name in scripts]
    modules = re.sub(r"^import .*$|^export ", "", "\n".join(texts), flags=re.MULTILINE)
    # A name may hold "</script>", which would end the script.
    content = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    style = (folder / "style.css").read_text(encoding="utf-8") + STYLE
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{style}</style></head><body><h1>{escape(title)}</h1><p>{escape(sentence)}</p>"
        f'<script type="module">{modules}\nconst DATA = {content};{show}</script></body></html>'
    )


def plain_numbers(values) -> list[float | None]:
    """Numbers to `DIGITS` digits, None for those that are not finite."""
    numbers = map(float, values)
    return [float(f"{one:.{DIGITS}g}") if math.isfinite(one) else None for one in numbers]
