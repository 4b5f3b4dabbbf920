"""What the command line prints: tables for people, JSON for programs."""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any


def print_json(content: dict[str, Any]) -> None:
    """Print for programs: JSON with plain lists, and null for what is no number."""
    print(json.dumps(_plain(content), indent=2, allow_nan=False))


def print_table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print for people: columns flush right under their names; nothing if there are no rows."""
    lines = [header, *([str(entry) for entry in row] for row in rows)]
    if len(lines) == 1:
        return
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    for line in lines:
        print("  ".join(entry.rjust(width) for entry, width in zip(line, widths, strict=True)))


def print_written(*paths: Path | None) -> None:
    """Say which files were written, of those that were asked for."""
    for path in filter(None, paths):
        print(f"written: {path}")


def _plain(value: Any) -> Any:
    """Arrays as lists, and what JSON has no number for as null."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
