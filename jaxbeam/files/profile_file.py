"""Measured profiles in files of separated values: positions and heights."""

import os
from pathlib import Path
from typing import Any

from jaxbeam.case.profiles.shapes import TableProfile
from jaxbeam.runtime.input_file import read_text_input

POINTS = ("positions", "heights", "point_heights")  # keys of a profile in the case file itself


def profile_from_file(path: str | os.PathLike) -> TableProfile:
    """Profile of a file with a position and a height (both in m) in each line.

    They are separated by a comma, semicolon, tab or spaces; further columns are left out. Empty
    lines and lines that begin with # are comments, and the first other line may name the columns.

    Raises ValueError, with the file and the line, for anything else, and for a file that is too
    large; OSError if the file cannot be read, or is a device or a pipe.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "road.csv"
    >>> _ = path.write_text(chr(10).join(["x, height", "0, 0", "5, 0.01", "10, 0"]))
    >>> print(profile_from_file(path).positions)
    [ 0.  5. 10.]
    """
    positions, heights = _read_points(Path(path))
    return TableProfile(positions, heights)


def with_profile_file(content: dict[str, Any], folder: Path, named: Any = None) -> dict[str, Any]:
    """Tables of a case file with the points of the profile in place of the file that has them.

    The file must be below the `folder` of the case; one that the user has `named` beside the case
    takes its place, and may be anywhere. Raises ValueError and OSError
    as `profile_from_file` does, and ValueError for a table with both points and a file.
    """
    profile = content.get("profile", {} if named is not None else None)
    if not isinstance(profile, dict):
        return content
    if named is not None:
        table = {"kind": "table"} | {k: v for k, v in profile.items() if k not in (*POINTS, "file")}
        table["positions"], table["point_heights"] = _read_points(Path(str(named)))
        return content | {"profile": table}
    if profile.get("kind") != "table" or "file" not in profile:
        return content
    table = dict(profile)
    name = table.pop("file")
    if not isinstance(name, str):
        raise ValueError(f"profile.file must be the name of a file in quotes, not {name!r}")
    for key in POINTS:
        if key in table:
            raise ValueError(f"profile has both a file and {key}; leave one out")
    table["positions"], table["point_heights"] = _read_points(folder / name, folder)
    return content | {"profile": table}


def _read_points(path: Path, below: Path | None = None) -> tuple[list[float], list[float]]:
    """Positions and heights (m) of a file."""
    text = read_text_input(path, "profile", below, "profile.file")
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
                # The line is not quoted: the file may hold secrets.
                raise ValueError(
                    f"{path}, line {number}: a line of a profile is a position and a height in m,"
                    " such as 12.5, 0.003, which this is not"
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
