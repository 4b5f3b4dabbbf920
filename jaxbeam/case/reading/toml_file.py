"""TOML files as dictionaries; no heavy imports, so that errors in a file appear at once."""

import os
import tomllib
from pathlib import Path
from typing import Any


def read_toml(path: str | os.PathLike, what: str = "case file") -> dict[str, Any]:
    """Tables of a file, validated as TOML only; `what` it is to the user.

    Raises OSError if the file cannot be read, ValueError if it is not UTF-8 or not valid TOML;
    both name the file.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise type(error)(f"cannot read the {what} {path}: {reason}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: a {what} is text in UTF-8, which this is not") from None
    except (ValueError, RecursionError) as error:  # RecursionError: lists nested without end
        raise ValueError(f"{path}: not valid TOML: {error}") from None
