"""Which channels of several setups are one place of the structure, and which are others.

By these channels logs are of one setup or of several.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int

from tuning.logs.log import Log
from tuning.logs.records import even_records
from tuning.modal.forced.forces import without_forces
from tuning.modal.result import Channels, channels_of
from tuning.modal.samples import MAX_RATE_CHANGE, same_channels, with_channels


def merged_channels(
    setups: Sequence[Channels], sources: Sequence[str], references: Sequence[str] | None
) -> tuple[Channels, tuple[Int[np.ndarray, " channel"], ...]]:
    """Channels of all setups, each place once, and where those of each setup are among them.

    Channels of one name and quantity are one place, unless the logs tell positions (or sensors of
    the case) that differ. With `references`, the channels of these names are, and no others.
    `sources` are the names of the logs, for messages.

    Raises ValueError for a reference that a setup lacks, and for setups that no common channel
    connects with the others.
    """
    for setup, source in zip(setups, sources, strict=True):
        lacking = set(references or ()) - set(setup.names)
        if lacking:
            raise ValueError(
                f"{source}: no channel {sorted(lacking)[0]!r}, which is to be a reference; "
                f"the channels are {', '.join(setup.names)}"
            )
    known = _known_places(setups)
    places: dict[tuple, int] = {}
    rows, indices = [], []
    for number, setup in enumerate(setups):
        of_setup = []
        for row in zip(*setup, strict=True):
            name, quantity, position, sensor = row
            key: tuple = (name, quantity)
            if references is not None:
                key = key if name in references else (*key, number)
            elif len(known[name]) > 1:
                unknown = position is None and sensor is None
                key = (*key, number) if unknown else (*key, position, sensor)
            if key not in places:
                places[key] = len(rows)
                rows.append((row, sources[number]))
            of_setup.append(places[key])
        indices.append(np.array(of_setup))
    _check_connected(setups, sources, indices)
    names = [row[0] for row, _ in rows]
    named = tuple(
        row[0] if names.count(row[0]) == 1 else _full_name(row, source) for row, source in rows
    )
    _, quantities, positions, sensors = zip(*(row for row, _ in rows), strict=True)
    return Channels(named, quantities, positions, sensors), tuple(indices)


def _known_places(setups: Sequence[Channels]) -> dict[str, set]:
    """Positions and sensors that the logs tell for each name of a channel."""
    known: dict[str, set] = {}
    for setup in setups:
        for name, _, position, sensor in zip(*setup, strict=True):
            told = known.setdefault(name, set())
            if position is not None or sensor is not None:
                told.add((position, sensor))
    return known


def _full_name(row: tuple, source: str) -> str:
    """Name of a channel that moves: with its position if it is known, else with its log."""
    name, _, position, _ = row
    return f"{name} at {position:g} m" if position is not None else f"{name} of {Path(source).stem}"


def _check_connected(setups: Sequence[Channels], sources: Sequence[str], indices) -> None:
    """Check that common channels lead from the first setup to all others."""
    joined, reached = {0}, set(indices[0].tolist())
    while more := [k for k in range(len(setups)) if k not in joined and reached & {*indices[k]}]:
        joined |= set(more)
        reached |= {int(i) for k in more for i in indices[k]}
    left = [k for k in range(len(setups)) if k not in joined]
    if left:
        raise ValueError(
            f"{sources[left[0]]}: no channel is common with {sources[0]}, by which their shapes "
            f"could be scaled (the channels are {', '.join(setups[left[0]].names)}; and "
            f"{', '.join(setups[0].names)}); references have the same name, quantity and position "
            "in both"
        )


def logs_of_setups(
    logs: Sequence[Log],
    references: Sequence[str] | None = None,
    channels: Sequence[str] | None = None,
) -> list[list[Log]]:
    """The logs of each setup: those with the same channels, positions and sampling rate.

    With `references`, channels of one name may be at different places in each log, and each is a
    setup of its own. Measured forces tell no setup apart: a hammer may strike many places.
    `channels` are the names of those that are to be used, by default all.

    Raises ValueError for references beside one log only, or that a log lacks, for setups without
    a common channel, a log with forces only, and samples that are not even.
    """
    if references is not None and len(logs) == 1:
        raise ValueError(
            f"{logs[0].source}: references connect several setups, and this is one log"
        )
    groups: list[list[Log]] = []
    for log in logs:
        own = next((group for group in groups if _same_setup(group[0], log)), None)
        if own is None or references is not None:
            groups.append([log])
        else:
            own.append(log)
    if len(groups) > 1:
        used = [_with_known(without_forces(group[0]), channels) for group in groups]
        merged_channels(
            [channels_of(log) for log in used], [log.source for log in used], references
        )
    return groups


def _with_known(log: Log, names: Sequence[str] | None) -> Log:
    """The log with those of some channels that it has; all of its own, if none."""
    return with_channels(log, [name for name in names or () if name in log.names] or None)


def _same_setup(a: Log, b: Log) -> bool:
    """Whether the channels but for forces, and the sampling rates, of two logs are the same."""
    if not same_channels(without_forces(a), without_forces(b)):
        return False
    rate, other = (even_records(log)[0] for log in (a, b))
    return abs(rate / other - 1) < MAX_RATE_CHANGE
