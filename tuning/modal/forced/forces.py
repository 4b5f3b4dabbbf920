"""Channels of measured forces in logs: told by the user, or by their unit (N)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from tuning.logs.log import Log
from tuning.logs.records import even_records
from tuning.modal.samples import Samples, part_of_window, with_channels

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
        # Without a force the responses tell the instants.
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
