"""Measured profiles in files of separated values: positions and heights."""

import os
from pathlib import Path
from typing import Any

from jaxbeam.case.profiles.table import TableProfile


def profile_from_file(path: str | os.PathLike) -> TableProfile:
    """Profile of a file with a position and a height (both in m) in each line.

    They are separated by a comma, semicolon, tab or spaces; further columns are left out. Empty
    lines and lines that begin with # are comments, and the first other line may name the columns.

    Raises ValueError, with the file and the line, for anything else; OSError if the file cannot be
    read.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "road.csv"
    >>> _ = path.write_text(chr(10).join(["x, height", "0, 0", "5, 0.01", "10, 0"]))
    >>> print(profile_from_file(path).positions)
    [ 0.  5. 10.]
    """
    positions, heights = _read_points(Path(path))
    return TableProfile(positions, heights)


def with_profile_file(content: dict[str, Any], path: str | os.PathLike) -> dict[str, Any]:
    """Tables of a case file with the points of the profile in place of the file that has them.

    `path` is that of the case file. Raises ValueError and OSError as `profile_from_file` does, and
    ValueError for a table with both points and a file.
    """
    profile = content.get("profile")
    if not isinstance(profile, dict) or profile.get("kind") != "table" or "file" not in profile:
        return content
    table = dict(profile)
    name = table.pop("file")
    if not isinstance(name, str):
        raise ValueError(f"profile.file must be the name of a file in quotes, not {name!r}")
    for key in ("positions", "heights", "point_heights"):
        if key in table:
            raise ValueError(f"profile has both a file and {key}; leave one out")
    table["positions"], table["point_heights"] = _read_points(Path(path).parent / name)
    return content | {"profile": table}


def _read_points(path: Path) -> tuple[list[float], list[float]]:
    """Positions and heights (m) of a file."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise type(error)(f"cannot read the profile {path}: {reason}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: a profile is text in UTF-8, which this is not") from None
    points: list[tuple[float, float]] = []
    has_names = False
    for number, line in enumerate(text.splitlines(), 1):
        cells = _cells(line)
        if not cells or cells[0].startswith("#"):
            continue
        try:
            points.append((float(cells[0]), float(cells[1])))
        except (ValueError, IndexError):
            if points or has_names or len(cells) < 2:
                raise ValueError(
                    f"{path}, line {number}: a line of a profile is a position and a height in m,"
                    f" such as 12.5, 0.003; it is {line.strip()[:80]!r}"
                ) from None
            has_names = True
    if len(points) < 2:
        raise ValueError(f"{path}: a profile needs at least two points; it has {len(points)}")
    positions, heights = map(list, zip(*points, strict=True))
    return positions, heights


def _cells(line: str) -> list[str]:
    """Cells of a line, separated by the first of tab, semicolon and comma in it, or by spaces."""
    separator = next((mark for mark in "\t;," if mark in line), None)
    return [cell.strip() for cell in line.split(separator)] if line.strip() else []
