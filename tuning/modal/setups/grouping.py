"""Which logs are records of one setup, by their channels."""

from collections.abc import Sequence

from tuning.logs.log import Log
from tuning.logs.records import even_records
from tuning.modal.forced.forces import without_forces
from tuning.modal.result import channels_of
from tuning.modal.samples import MAX_RATE_CHANGE, same_channels, with_channels
from tuning.modal.setups.channels import merged_channels


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
