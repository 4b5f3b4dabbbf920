"""TOML files as dictionaries; no heavy imports, so that errors in a file appear at once."""

import os
import tomllib
from pathlib import Path
from typing import Any

MAX_DEPTH = 32  # of tables and lists within each other; no file that people write comes near


def read_toml(path: str | os.PathLike, what: str = "case file") -> dict[str, Any]:
    """Tables of a file, validated as TOML only; `what` it is to the user.

    Raises OSError if the file cannot be read, ValueError if it is not UTF-8, not valid TOML, or
    nested without end; both name the file.
    """
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise type(error)(f"cannot read the {what} {path}: {reason}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: a {what} is text in UTF-8, which this is not") from None
    except (ValueError, RecursionError) as error:  # RecursionError: lists nested without end
        raise ValueError(f"{path}: not valid TOML: {error}") from None
    if _depth_exceeds(content, MAX_DEPTH):
        raise ValueError(f"{path}: tables or lists are nested more than {MAX_DEPTH} deep")
    return content


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
