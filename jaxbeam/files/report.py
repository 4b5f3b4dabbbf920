"""Tables and pages of reports, in Markdown and HTML."""

import html as escaping
from collections.abc import Callable, Sequence

Row = Sequence[str]

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
       color: #22282e }
table { border-collapse: collapse; font-size: 0.85rem; margin: 1rem 0 }
th, td { text-align: left; padding: 0.2rem 0.8rem 0.2rem 0; border-bottom: 1px solid #dfe3e6 }
td { font-variant-numeric: tabular-nums }
img { max-width: 100% }
"""


def markdown_table(header: Row, rows: Sequence[Row]) -> list[str]:
    """Lines of a table in Markdown, and an empty one after it."""
    lines = [header, ["---"] * len(header), *rows]
    return [f"| {' | '.join(line)} |" for line in lines] + [""]


def html_table(
    header: Row, rows: Sequence[Row], style_of: Callable[[str], str | None] = lambda cell: None
) -> str:
    """A table in HTML; `style_of` may give cells of the rows a class of the page's style."""

    def line(tag: str, cells: Row, chosen: Callable[[str], str | None]) -> str:
        inner = []
        for cell in cells:
            name = chosen(cell)
            start = f"<{tag}>" if name is None else f'<{tag} class="{name}">'
            inner.append(f"{start}{escaping.escape(cell)}</{tag}>")
        return f"<tr>{''.join(inner)}</tr>"

    body = "".join(line("td", row, style_of) for row in rows)
    return f"<table>{line('th', header, lambda cell: None)}{body}</table>"


def page(title: str, body: Sequence[str], style: str = "") -> str:
    """A page of HTML; `style` is added to that of all reports."""
    safe = escaping.escape(title)
    head = f'<meta charset="utf-8"><title>{safe}</title><style>{STYLE}{style}</style>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(body)}</body></html>'
