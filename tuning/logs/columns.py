"""Columns of a table that the user names, and times from a sampling rate."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tuning.logs.readers import LogTable, is_time_name, parse_heading
from tuning.logs.units import UNITS

SKIPPED = "-"  # name of a column that is not needed


def with_named_columns(
    path: Path, table: LogTable, columns: Sequence[str] | str | None
) -> tuple[LogTable, list[str] | None, dict[str, str]]:
    """The table with names for columns that have none, the channels wanted, and units given.

    `columns` are headings, such as `a1 [g]`, as a sequence or separated by commas.

    Raises ValueError for a table without headings if no columns, or another number, are given.
    """
    headings = columns.split(",") if isinstance(columns, str) else list(columns or ())
    parsed = [parse_heading(heading) for heading in headings]
    if table.has_headings:
        # A name with brackets may be one of the file; otherwise they hold the unit.
        names = [h.strip() if h.strip() in table.names else n
                 for h, (n, _) in zip(headings, parsed, strict=True)]  # fmt: skip
        units = {n: u for n, (_, u) in zip(names, parsed, strict=True) if u}
        return table, names or None, units
    count = len(table.names)
    line = "" if table.lines is None else f", line {table.lines[0]}"
    example = ", ".join(["time [s]", *(f"a{i} [g]" for i in range(1, count))])
    if not headings:
        raise ValueError(
            f"{path}{line}: the file has no headings; name its {count} columns, with units, e.g. "
            f'columns="{example}" (--columns), or write them into its first line'
        )
    if len(headings) != count:
        raise ValueError(
            f"{path}{line}: {len(headings)} columns are named, but the file has {count}; name all, "
            f'e.g. columns="{example}", or "{SKIPPED}" for one that is not needed'
        )
    kept = [i for i, (name, _) in enumerate(parsed) if name != SKIPPED]
    table = dataclasses.replace(
        table,
        names=tuple(parsed[i][0] for i in kept),
        units=tuple(parsed[i][1] for i in kept),
        values=table.values[:, kept],
        has_headings=True,
    )
    return table, None, {}


def with_times(path: Path, table: LogTable, rate: float | None, time: str | None) -> LogTable:
    """The table with times from a sampling rate (Hz); unchanged without one.

    Raises ValueError for a rate that is not positive and for a table that has times.
    """
    if rate is None:
        return table
    if not 0 < rate < np.inf:
        raise ValueError(f"{path}: the sampling rate must be positive, not {rate:g} Hz")
    named = time or table.time or next(
        (
            name
            for name, unit in zip(table.names, table.units, strict=True)
            if is_time_name(name) or (unit in UNITS and UNITS[unit].quantity == "time")
        ),
        None,
    )  # fmt: skip
    if named is not None:
        raise ValueError(
            f"{path}: the log has a column of times, {named!r}; leave the sampling rate out, or "
            "read the file without that column"
        )
    times = np.arange(len(table.values)) / rate
    return dataclasses.replace(
        table,
        names=("time", *table.names),
        units=("s", *table.units),
        values=np.column_stack([times, table.values]),
        time="time",
    )
