"""TOML files as dictionaries; no heavy imports, so that errors in a file appear at once."""

import os
import re
import tomllib
from pathlib import Path
from typing import Any

MAX_DEPTH = 32  # of tables and lists within each other; no file that people write comes near


def read_toml(path: str | os.PathLike, what: str = "case file") -> dict[str, Any]:
    """Tables of a file, validated as TOML only; `what` it is to the user.

    Raises OSError if the file cannot be read, ValueError if it is not UTF-8, not valid TOML, or
    nested without end; both name the file.
    """
    text = ""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        content = tomllib.loads(text)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise type(error)(f"cannot read the {what} {path}: {reason}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: a {what} is text in UTF-8, which this is not") from None
    except (ValueError, RecursionError) as error:  # RecursionError: lists nested without end
        raise ValueError(f"{path}: not valid TOML: {error}{_hint(text, str(error))}") from None
    if _depth_exceeds(content, MAX_DEPTH):
        raise ValueError(f"{path}: tables or lists are nested more than {MAX_DEPTH} deep")
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
