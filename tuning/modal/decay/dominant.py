"""Whether free decays stand for a log, and what was before them."""

import numpy as np
from jaxtyping import Bool, Float

from tuning.modal.decay.stretches import CONTACT_SAMPLES, MIN_DECAY_CYCLES, Stretch

MIN_DECAY_ENERGY = 0.3  # share of the energy of a log in its decays, if they are to stand for it
LONG_FALL_NEPERS = 1.5  # or fall of the energy; 95 % of that of an exponential falls by 3
MIN_START_LEVEL = 0.2  # energy at the start of such a decay over the mean energy of the log


def dominate(
    decays: tuple[Stretch, ...],
    struck: tuple[Bool[np.ndarray, " time"], ...],
    records: tuple[Float[np.ndarray, "sample channel"], ...],
    ratio: float,
    cycle: float,
) -> bool:
    """Whether decays hold much of the energy of a log, or one falls far, or follows a load.

    `struck` are samples of the log, `ratio` those of `records` over these; `cycle` is that of the
    strongest vibration in samples of `records`. A decay that begins far below the level of the log,
    long after blows, lacks the modes that were gone by then; one that begins where a lasting
    excitation ends has them all, however much stronger the excitation was, and how far it falls is
    of no matter.
    """
    inside = sum(
        np.sum(records[d.record][int(d.start * ratio) : int(d.stop * ratio)] ** 2) for d in decays
    )
    whole = sum(np.sum(record**2) for record in records)
    level = whole / sum(map(len, records))
    longest = max(decays, key=lambda d: d.fall)
    start = int(np.ceil(longest.start * ratio))
    first = records[longest.record][start : start + int(2 * cycle) + 1]
    begins = np.sum(first**2) / len(first) > MIN_START_LEVEL * level
    falls = begins and longest.fall > LONG_FALL_NEPERS
    has_followed = follows(longest, struck[longest.record], cycle / ratio)
    return bool(inside > MIN_DECAY_ENERGY * whole or falls or has_followed)


def after_soft_blows(
    decays: tuple[Stretch, ...], struck: tuple[Bool[np.ndarray, " time"], ...]
) -> bool:
    """Whether there are several decays in records in which no excitation was found."""
    return len(decays) > len(struck) and not any(marks.any() for marks in struck)


def follows(decay: Stretch, struck: Bool[np.ndarray, " time"], cycle: float) -> bool:
    """Whether a decay begins where the structure was excited for five cycles or more.

    `cycle` is that of the strongest vibration in samples of the log, as are `struck` ones.
    """
    before = struck[: max(decay.start - 2, 0)][-int(MIN_DECAY_CYCLES * cycle) :]
    return bool(before.size and before.all())


def after_blow(decay: Stretch, struck: Bool[np.ndarray, " time"], cycle: float) -> bool:
    """Whether a decay begins right after a blow, not after a lasting excitation.

    `cycle` is that of the strongest vibration in samples of the log, as are `struck` ones.
    """
    before = struck[max(decay.start - CONTACT_SAMPLES, 0) : decay.start]
    return bool(before.any()) and not follows(decay, struck, cycle)
