"""Which logs are records of one setup, by their channels."""

from collections.abc import Sequence

from tuning.logs.log import Log
from tuning.logs.records import even_records
from tuning.modal.forced.forces import without_forces
from tuning.modal.samples import MAX_RATE_CHANGE, same_channels


def logs_of_setups(logs: Sequence[Log], references: Sequence[str] | None = None) -> list[list[Log]]:
    """The logs of each setup: those with the same channels, positions and sampling rate.

    With `references`, channels of one name may be at different places in each log, and each is a
    setup of its own. Measured forces tell no setup apart: a hammer may strike many places.

    Raises ValueError for references beside one log only, a log with forces only, and samples that
    are not even.
    """
    if references is not None and len(logs) == 1:
        raise ValueError(
            f"{logs[0].source}: references connect several setups, and this is one log"
        )
    if references is not None:
        return [[log] for log in logs]
    groups: list[list[Log]] = []
    for log in logs:
        own = next((group for group in groups if _same_setup(group[0], log)), None)
        if own is None:
            groups.append([log])
        else:
            own.append(log)
    return groups


def _same_setup(a: Log, b: Log) -> bool:
    """Whether the channels but for forces, and the sampling rates, of two logs are the same."""
    if not same_channels(without_forces(a), without_forces(b)):
        return False
    rate, other = (even_records(log)[0] for log in (a, b))
    return abs(rate / other - 1) < MAX_RATE_CHANGE
