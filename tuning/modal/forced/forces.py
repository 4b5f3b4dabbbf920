"""Channels of measured forces in logs: told by the user, or by their unit (N)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from tuning.logs.log import Log
from tuning.logs.records import even_records
from tuning.modal.samples import Samples, part_of_window, with_channels

FORCE = "force"


def force_names(log: Log, wanted: Sequence[str] | None) -> tuple[str, ...]:
    """Channels of the measured forces in a log, by default all in N that are no commands.

    Raises ValueError for a channel that the log has not, or that is no force.
    """
    if wanted is None:
        return tuple(
            name
            for name, quantity, actuator in zip(
                log.names, log.quantities, log.actuators, strict=True
            )
            if quantity == FORCE and actuator is None
        )
    chosen = with_channels(log, wanted)
    for name, quantity, unit in zip(chosen.names, chosen.quantities, chosen.units, strict=True):
        if quantity != FORCE:
            raise ValueError(
                f"{log.source}: channel {name!r} is in {unit}, which is no force; give its unit as "
                f"N in the heading or by columns, or another channel"
            )
    return chosen.names


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
    """Forces at the instants of the records of the responses (`samples`), without offset."""
    found = []
    for log in logs:
        rate, records, _ = even_records(part_of_window(with_channels(log, names), window))
        found += [(record.start, record.values, rate) for record in records]
    matched = []
    for start, record, (first, values, rate) in zip(
        samples.starts, samples.records, found, strict=True
    ):
        skipped = round((start - first) * rate)
        force = values[skipped : skipped + len(record)]
        matched.append(force - np.median(force, axis=0))
    return tuple(matched)
