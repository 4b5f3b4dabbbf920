"""Impacts in logs, at samples that cannot be predicted, and whether decays follow the hardest."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from tuning.modal.decay.stretches import MIN_DECAY_CYCLES, Stretch
from tuning.modal.preprocessing import Samples, prepare

MAX_CONTACT = 40  # samples that an impact marks; more are a lasting excitation
APART_CYCLES = 2.0  # of the lowest frequency, after which an impact is no rebound of another
AFTER_CYCLES = 2.0  # of the lowest frequency, in which an impact's energy is compared


class Impact(NamedTuple):
    """Record, and the sample in it, at which the structure was hit."""

    record: int
    sample: int


def marked_impacts(
    impacted: tuple[Bool[np.ndarray, " time"], ...], rate: float, band: tuple[float, float]
) -> tuple[Impact, ...]:
    """Impacts amid marked samples of records at a `rate` (Hz), for a band (Hz)."""
    found: list[Impact] = []
    for record, marks in enumerate(impacted):
        places = np.flatnonzero(marks)
        if not places.size:
            continue
        for group in np.split(places, np.flatnonzero(np.diff(places) > MAX_CONTACT / 2) + 1):
            impact = Impact(record, int(group[0] + group[-1]) // 2)
            rebound = (
                found
                and impact.record == found[-1].record
                and (impact.sample - found[-1].sample <= _apart(rate, band))
            )
            if group[-1] - group[0] < MAX_CONTACT and not rebound:
                found.append(impact)
    return tuple(found)


def _apart(rate, band) -> int:
    """Least distance of two impacts in samples."""
    return int(APART_CYCLES * rate / band[0]) + 1


def impacts_left_out(
    samples: Samples,
    excited: tuple[Bool[np.ndarray, " time"], ...],
    decays: Sequence[Stretch],
    band: tuple[float, float],
) -> list[str]:
    """A sentence if no decay that is used follows the impact that leaves most energy in a band
    (Hz).

    `excited` are the samples at which the structure is excited.
    """
    impacts = marked_impacts(excited, samples.rate, band)
    if not impacts:
        return []
    prepared = prepare(samples.records, samples.starts, samples.rate, band)
    ratio = prepared.rate / samples.rate
    cycles = int(AFTER_CYCLES * samples.rate / band[0])

    def energy(impact: Impact) -> float:
        first = int(impact.sample * ratio)
        part = prepared.records[impact.record][first : first + max(int(cycles * ratio), 1)]
        return float(np.sum(part**2))

    hardest = max(impacts, key=energy)
    later = [b.sample for b in impacts if b.record == hardest.record and b.sample > hardest.sample]
    last = min([hardest.sample + cycles, *later])
    if any(
        one.record == hardest.record and one.start <= last and hardest.sample < one.stop
        for one in decays
    ):
        return []
    start = samples.starts[hardest.record] + hardest.sample / samples.rate
    wait = (min(later) - hardest.sample) / samples.rate if later else np.inf
    why = "what follows it is not the free decay with most information"
    if wait * band[0] < MIN_DECAY_CYCLES:
        why = f"the next impact comes {wait:.3g} s later"
    return [f"the hardest impact, at {start:.4g} s, is left out: {why}"]
