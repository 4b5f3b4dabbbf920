"""Measured forces: their channels in logs, impacts of a hammer in them, and windows of these.

A force window keeps the impact and drops the noise of the force sensor after it. An exponential
window exp(-t / T) lets the response fade before the noise prevails, or before the record ends. As
exp(-a t) (h * f) = (exp(-a t) h) * (exp(-a t) f), it multiplies force and response alike and then
adds a = 1 / T to each decay rate, which is subtracted from what is identified: exact for any force
(Fladung and Rost 1997).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from tuning.logs.log import Log, even_records
from tuning.modal.preprocessing import Samples, part_of_window, with_channels

FORCE = "force"


def force_names(logs: Sequence[Log], wanted: Sequence[str] | None) -> tuple[str, ...]:
    """Channels of the measured forces in logs, by default all in N that are no commands.

    A hammer that strikes another place in each log has a name for each: a force that a log lacks
    did not act while it was measured.

    Raises ValueError for a channel that no log has, or that is no force.
    """
    if wanted is None:
        return tuple(dict.fromkeys(name for log in logs for name in _forces_of(log)))
    for name in wanted:
        log = next((one for one in logs if name in one.names), logs[0])
        chosen = with_channels(log, (name,))
        if chosen.quantities[0] != FORCE:
            raise ValueError(
                f"{log.source}: channel {name!r} is in {chosen.units[0]}, which is no force; give "
                f"its unit as N in the heading or by columns, or another channel"
            )
    return tuple(wanted)


def _forces_of(log: Log) -> list[str]:
    """Channels in N that are no commands."""
    return [
        name
        for name, quantity, actuator in zip(log.names, log.quantities, log.actuators, strict=True)
        if quantity == FORCE and actuator is None
    ]


def without_forces(log: Log) -> Log:
    """The log without its channels of force.

    Raises ValueError if no other channel is left.
    """
    kept = [name for name, q in zip(log.names, log.quantities, strict=True) if q != FORCE]
    if not kept:
        raise ValueError(f"{log.source}: the log has forces only, and no response to them")
    return with_channels(log, kept)


def force_records(
    logs: Sequence[Log],
    names: Sequence[str],
    window: tuple[float, float] | None,
    samples: Samples,
) -> tuple[Float[np.ndarray, "time force"], ...]:
    """Forces at the instants of the records of the responses (`samples`), without offset.

    A force that a log lacks is zero in its records.
    """
    found = []
    for log in logs:
        own = [name for name in names if name in log.names]
        # Without a force the instants are those of the responses.
        rate, records, _ = even_records(part_of_window(with_channels(log, own or None), window))
        for record in records:
            values = np.zeros((len(record.values), len(names)))
            if own:
                values[:, [names.index(name) for name in own]] = record.values
            found.append((record.start, values, rate))
    matched = []
    for start, record, (first, values, rate) in zip(
        samples.starts, samples.records, found, strict=True
    ):
        skipped = round((start - first) * rate)
        force = values[skipped : skipped + len(record)]
        matched.append(force - np.median(force, axis=0))
    return tuple(matched)


IMPACT_LEVEL = 0.1  # of the largest force, above which there is an impact
MAX_IMPACT_TIME = 0.05  # fraction of the samples of a log of impacts with an impact
BEFORE = 8  # samples before an impact that belong to it: ringing of an anti-alias filter


class Windows(NamedTuple):
    """Time constant T (s) of the exponential window, duration (s) of the force window, or None."""

    exponential: float | None = None
    force: float | None = None

    @property
    def decay_rate(self) -> float:
        """Decay rate (1/s) that the exponential window adds to that of each mode."""
        return 0.0 if self.exponential is None else 1 / self.exponential


def check_windows(windows: Windows) -> None:
    """Check windows.

    Raises ValueError for a duration that is not above zero.
    """
    for name, value in zip(("exponential", "force"), windows, strict=True):
        if value is not None and not 0 < value < np.inf:
            raise ValueError(f"the {name} window must last longer than 0 s, not {value:g} s")


def find_impacts(force: Float[np.ndarray, "time force"]) -> Int[np.ndarray, " impact"]:
    """Samples at which impacts begin, none if the force is no hammer's.

    A hammer's force is above a tenth of its largest value for a twentieth of the time at most.
    """
    size = np.max(np.abs(force) / np.maximum(np.abs(force).max(axis=0), 1e-300), axis=1)
    excited = size > IMPACT_LEVEL
    if not excited.any() or excited.mean() > MAX_IMPACT_TIME:
        return np.zeros(0, int)
    begins = np.flatnonzero(excited & ~np.concatenate([[False], excited[:-1]]))
    # Rebounds and ringing filters cross the level again at once.
    far = np.diff(begins, prepend=-len(force)) > 4 * excited.sum() / begins.size + 2
    return begins[far]


def _impacts_of(force):
    """Samples at which impacts begin. Raises ValueError if there are none."""
    impacts = find_impacts(force)
    if not impacts.size:
        raise ValueError("the measured force has no impacts of a hammer, and windows are for these")
    return impacts


def force_at_impacts(
    force: Float[np.ndarray, "time force"], rate: float, duration: float
) -> Float[np.ndarray, "time force"]:
    """The force for `duration` s from each impact on, and a little before; else zero.

    Raises ValueError if there is no impact.
    """
    kept = np.zeros(len(force), bool)
    for impact in _impacts_of(force).tolist():
        kept[max(impact - BEFORE, 0) : impact + max(int(duration * rate), 1)] = True
    return np.where(kept[:, None], force, 0.0)


def pieces_of_impacts(
    record: Float[np.ndarray, "time output"],
    force: Float[np.ndarray, "time force"],
    rate: float,
    windows: Windows,
) -> list[tuple[Float[np.ndarray, "sample output"], Float[np.ndarray, "sample force"]]]:
    """Response and force from each impact on for the shortest time between impacts, with windows.

    Pieces begin a little before their impact. Raises ValueError if there is no impact.
    """
    impacts = _impacts_of(force)
    if windows.force is not None:
        force = force_at_impacts(force, rate, windows.force)
    length = int(np.diff(np.append(impacts, len(record))).min())
    fade = np.exp(-windows.decay_rate * np.arange(length) / rate)[:, None]
    starts = np.maximum(impacts - BEFORE, 0).tolist()
    return [
        (record[first : first + length] * fade, force[first : first + length] * fade)
        for first in starts
        if first + length <= len(record)
    ]
