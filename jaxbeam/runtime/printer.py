"""Tables: as text, in HTML and Markdown; views of results with columns; labelled datasets.

Nothing heavy is imported at the top, so that the command line may use it.
"""

import abc
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy
    import pandas  # imported where it is used, as it takes half a second
    import xarray

Row = Sequence[str]
NO_BREAK = "\N{NO-BREAK SPACE}"
GAP = 2  # spaces between columns
LEAST_WIDTH = 20  # of a terminal; in a narrower one lines are broken
UNIT = re.compile(r"\([^()]{1,9}\)")  # as "(N m)", which is not broken
MAX_SHOWN = 20  # rows of a result


def counted(number: int, noun: str, plural: str = "") -> str:
    """A number of things, as in a sentence.

    >>> counted(1, "load"), counted(3, "load"), counted(2, "entry", "entries")
    ('1 load', '3 loads', '2 entries')
    """
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def terminal_width() -> int | None:
    """Characters in a line: COLUMNS, or those of the terminal; None where output goes elsewhere."""
    try:
        asked = os.environ.get("COLUMNS", "")
        if not asked.isdecimal() and not sys.stdout.isatty():
            return None
        width = int(asked) if asked.isdecimal() else os.get_terminal_size().columns
    except (OSError, AttributeError):  # no terminal, no standard output
        return None
    return max(width, LEAST_WIDTH) if width else None


def text_table(
    header: Row,
    rows: Iterable[Row],
    alignment: str = "",
    indent: str = "",
    width: int | None = None,
) -> list[str]:
    """Lines of a table, columns two spaces apart, within a width (characters).

    By default it is `terminal_width`. Where the table is wider its words are wrapped, then its
    columns printed in several tables below each other, each beginning with the first. `alignment`
    has a letter for each column, "<" for flush left and ">" for flush right, as in format strings;
    all are flush left if it is left out.

    >>> rows = [("loads.0.speed", "12.5", "at its upper bound")]
    >>> print("\\n".join(text_table(("parameter", "value", ""), rows, "<><", width=30)))
    parameter      value
    loads.0.speed   12.5  at its
                          upper
                          bound
    """
    limit = (width or terminal_width() or sys.maxsize) - len(indent)
    columns = [[UNIT.sub(_unbroken, cell) for cell in c] for c in zip(header, *rows, strict=True)]
    natural = [max(map(len, column)) for column in columns]
    least = [max(len(w) for cell in column for w in cell.split(" ")) for column in columns]
    lines: list[str] = []
    for group, widths in _groups(natural, least, limit):
        marks = [(alignment or "<" * len(columns))[i] for i in group]
        lines += [""] if lines else []
        for number, row in enumerate(zip(*(columns[i] for i in group), strict=True)):
            lines += [indent + line for line in _row_lines(row, marks, widths, number == 0)]
    return [line.replace(NO_BREAK, " ").rstrip() for line in lines]


def _unbroken(unit: re.Match) -> str:
    return unit[0].replace(" ", NO_BREAK)


def _groups(
    natural: list[int], least: list[int], limit: int
) -> Iterator[tuple[list[int], list[int]]]:
    """Groups of columns that fit next to each other, each with the first column, and widths."""
    if sum(natural) + GAP * (len(natural) - 1) <= limit:
        yield list(range(len(natural))), natural
        return
    key = min(least[0], max(limit // 2, limit - GAP - max(least[1:], default=-GAP)))
    least = [key, *(min(one, limit - key - GAP) for one in least[1:])]
    rest = list(range(1, len(natural)))
    while True:
        group = [0]
        while rest and sum(least[i] + GAP for i in group) + least[rest[0]] <= limit:
            group.append(rest.pop(0))
        widths = {i: natural[i] for i in group}
        while sum(widths.values()) + GAP * (len(group) - 1) > limit:
            widest = max((i for i in group if widths[i] > least[i]), key=widths.__getitem__)
            widths[widest] -= 1
        yield group, list(widths.values())
        if not rest:
            return


def _row_lines(row: Row, marks: Row, widths: list[int], is_header: bool) -> Iterator[str]:
    """Lines of a row, words of its cells wrapped; those of a header end at its foot."""
    cells = [
        [cell] if len(cell) <= width else textwrap.wrap(cell, max(width, 1)) or [""]
        for cell, width in zip(row, widths, strict=True)
    ]
    height = max(map(len, cells))
    for i in range(height):
        parts = []
        for cell, mark, width in zip(cells, marks, widths, strict=True):
            place = i - (height - len(cell)) * is_header
            parts.append(f"{cell[place] if 0 <= place < len(cell) else '':{mark}{width}}")
        yield (" " * GAP).join(parts)


def markdown_table(header: Row, rows: Iterable[Row], right_from: int | None = None) -> list[str]:
    """Lines of a table in Markdown; columns from `right_from` on, if any, are flush right."""
    left = len(header) if right_from is None else right_from
    lines = [header, ["---"] * left + ["---:"] * (len(header) - left), *rows]
    return [f"| {' | '.join(line)} |" for line in lines] + [""]


def html_table(
    header: Row,
    rows: Iterable[Row],
    caption: str = "",
    cell_class: Callable[[str], str | None] = lambda cell: None,
) -> str:
    """A table in HTML, its texts escaped, flush left under the caption.

    `cell_class` returns the CSS class of a cell's text, or None.
    """
    style = ' style="text-align: left"' if caption else ""

    def line(tag: str, cells: Row) -> str:
        named = [(cell, cell_class(cell) if tag == "td" else None) for cell in cells]
        inner = (
            f"<{tag}{style}>{escape(cell)}</{tag}>"
            if name is None
            else f'<{tag}{style} class="{name}">{escape(cell)}</{tag}>'
            for cell, name in named
        )
        return f"<tr>{''.join(inner)}</tr>"

    head = f"<caption{style}><b>{escape(caption)}</b></caption>" if caption else ""
    body = "".join(line("td", row) for row in rows)
    return f"<table>{head}<thead>{line('th', header)}</thead><tbody>{body}</tbody></table>"


class TableViews:
    """Base of results that have columns of equally many entries by their heads."""

    @property
    @abc.abstractmethod
    def columns(self) -> "dict[str, numpy.ndarray]":
        """Columns by head, with units, as "frequency (Hz)"."""

    @property
    def headline(self) -> str:
        """Sentence above the table in a notebook: the verdict of a result that has one."""
        return getattr(self, "verdict", type(self).__name__)

    def to_dataframe(self) -> "pandas.DataFrame":
        """Columns as a table of pandas, the first of them as its index.

        Raises ImportError, with what to install, without pandas.
        """
        try:
            import pandas
        except ImportError:
            raise ImportError(
                "a dataframe needs pandas, which is not installed: pip install pandas; .columns has"
                " the same arrays by their heads"
            ) from None
        first, *_ = columns = self.columns
        return pandas.DataFrame(dict(columns)).set_index(first)

    def __repr__(self) -> str:
        """The table under its headline; of traced or several results the arrays."""
        if (table := self._shown_table()) is None:
            return super().__repr__()
        numeric = (column.dtype.kind in "fiu" for column in self.columns.values())
        alignment = "".join("<>"[is_number] for is_number in numeric)
        return "\n".join([self.headline, *text_table(*table, alignment, indent="  ")])

    def _repr_html_(self) -> str | None:
        """Table of the columns in a notebook; None leaves traced or several results to the text."""
        if (table := self._shown_table()) is None:
            return None
        remarks = "".join(f"<p>{escape(one)}</p>" for one in getattr(self, "remarks", ()))
        return html_table(*table, self.headline) + remarks

    def _shown_table(self) -> tuple[list[str], list[list[str]]] | None:
        """Heads and the first rows of the table; None of traced or several results."""
        from jaxbeam.runtime.arrays import any_traced

        if any_traced(self):
            return None
        columns = self.columns
        lengths = {column.shape for column in columns.values()}
        if len(lengths) != 1 or len(next(iter(lengths))) != 1:
            return None
        rows = [[_cell(entry) for entry in row] for row in zip(*columns.values(), strict=True)]
        if len(rows) > MAX_SHOWN:
            more = f"... {len(rows) - MAX_SHOWN} more ..."
            rows[MAX_SHOWN - 1 : -1] = [[more, *[""] * (len(columns) - 1)]]
        return list(columns), rows


def _cell(entry: Any) -> str:
    """Text of an entry of a column: six digits of a number, nothing for NaN."""
    if isinstance(entry, str):
        return entry
    return "" if entry != entry else f"{entry:.6g}"


def labelled_dataset(
    variables: Mapping[str, tuple],
    coordinates: Mapping[str, tuple],
    attributes: Mapping[str, Any] | None = None,
) -> "xarray.Dataset":
    """`xarray.Dataset` of tuples (dimensions, array, attributes), the last of which may be missing.

    The same dataset sooner: told that arrays are NumPy's, xarray does not import dask and pint,
    half a second, to see whether they are theirs.
    """
    import numpy as np
    import pandas
    import xarray

    def variable(dimensions, values, attributes=None):
        dimensions = (dimensions,) if isinstance(dimensions, str) else tuple(dimensions)
        return xarray.Variable(dimensions, np.asarray(values), attributes, fastpath=True)

    own = {name: variable(*given) for name, given in coordinates.items()}
    indexes = {
        name: xarray.indexes.PandasIndex(
            pandas.Index(one.data, dtype=object if one.dtype == object else None), name, one.dtype
        )
        for name, one in own.items()
        if one.dims == (name,)
    }
    for name, index in indexes.items():
        own |= index.create_variables({name: own[name]})
    return xarray.Dataset(
        {name: variable(*given) for name, given in variables.items()},
        xarray.Coordinates(own, indexes),
        attributes,
    )
