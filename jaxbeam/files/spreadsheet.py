"""Texts in tables that a spreadsheet may open: none is run as a formula.

A cell that begins with = + - @, a tab or a line break is a formula, or may become one, to Excel,
LibreOffice and Google Sheets, in .csv files as in .xlsx. An apostrophe before it makes it text
("CSV Injection", OWASP).
"""

import re

_FORMULA = re.compile(r"'*[=+\-@\t\r\n＝＋－＠]")


def as_text_cell(text: str) -> str:
    """Text of a cell that no spreadsheet runs; `from_text_cell` restores it.

    >>> as_text_cell("=1+1"), as_text_cell("midspan")
    ("'=1+1", 'midspan')
    """
    return f"'{text}" if _FORMULA.match(text) else text


def from_text_cell(cell: str) -> str:
    """The text of which `as_text_cell` made a cell.

    >>> from_text_cell("'=1+1"), from_text_cell("'t Zand")
    ('=1+1', "'t Zand")
    """
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell
