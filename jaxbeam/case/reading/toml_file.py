"""TOML files as dictionaries; no heavy imports, so that errors in a file appear at once."""

import os
import re
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

from jaxbeam.case.limits import check_length
from jaxbeam.runtime.input_file import read_text_input

_LISTED = re.compile(r"^[ \t]*\[\[[ \t]*(\w+)[ \t]*\]\]", re.MULTILINE)  # [[sensors]]
MAX_DEPTH = 32  # of tables and lists within each other; no file that people write comes near


def read_toml(
    path: str | os.PathLike,
    what: str = "case file",
    below: Path | None = None,
    address: str = "",
) -> dict[str, Any]:
    """Tables of a file, validated as TOML only; `what` it is to the user.

    A file that another one names at an `address` must be `below` the folder of that one. Raises
    OSError if the file cannot be read, ValueError if it is elsewhere, too large, not UTF-8, not
    valid TOML, nested without end, or has more tables than a case may have; both name the file.
    """
    text = read_text_input(path, what, below, address)
    try:
        return parse_toml(text, quoted=below is None)  # nothing of other files
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def parse_toml(text: str, quoted: bool = True) -> dict[str, Any]:
    """Tables of a text, validated as TOML only.

    Raises ValueError as `read_toml`, with a hint on a wrong value, which may be `quoted` in it.
    """
    for name, count in Counter(_LISTED.findall(text)).items():
        check_length(name, count)  # to parse so many would take long
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # RecursionError: lists nested without end
        hint = _hint(text, str(error)) if quoted else ""
        raise ValueError(f"not valid TOML: {error}{hint}") from None
    if _depth_exceeds(content, MAX_DEPTH):
        raise ValueError(f"tables or lists are nested more than {MAX_DEPTH} deep")
    return content


def _hint(text: str, error: str) -> str:
    """What is likely wrong with the value of the line of an error, or nothing."""
    found = re.search(r"at line (\d+)", error)
    line = text.splitlines()[int(found[1]) - 1] if found else ""
    value = line.partition("=")[2].split("#")[0].strip()
    if re.fullmatch(r"[-+]?\d+,\d+", value):
        return f": write a decimal point, {value.replace(',', '.')}"
    if re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)? *[a-zA-Zµ%].*", value):
        return f': put a number with a unit in quotes, "{value}"'
    if re.fullmatch(r"[a-zA-Z][\w-]*", value):
        return f': put a word in quotes, "{value}"'
    return ""


def _depth_exceeds(content: Any, limit: int) -> bool:
    """Whether tables and lists are nested deeper than a limit; without recursion."""
    level: list[Any] = [content]
    for _ in range(limit + 1):
        level = [
            inner
            for one in level
            for inner in (one.values() if isinstance(one, dict) else one)
            if isinstance(inner, dict | list)
        ]
        if not level:
            return False
    return True
