"""Records that begin at a blow: a structure at rest before its first blow tells nothing of it.

What vibrates from the start of a record on and what an early blow leaves are hardly told from each
other. A blow that no search has found is seen in the errors: no vibration fits rest before it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.modal.forced.common_denominator import Lines
from tuning.modal.struck.instants import Blow, Response, bins_of

EARLY = 0.1  # of a record, within which a blow begins it


class StruckRecords(NamedTuple):
    """Records from the samples `begins` of whole ones on, and the blows after these."""

    records: tuple[Float[np.ndarray, "_ channel"], ...]
    begins: tuple[int, ...]
    blows: tuple[Blow, ...]

    def later(self, samples: Sequence[int]) -> "StruckRecords":
        """The same from some samples of the records on."""
        shifted = [Blow(blow.record, blow.sample - samples[blow.record]) for blow in self.blows]
        return StruckRecords(
            tuple(record[n:] for record, n in zip(self.records, samples, strict=True)),
            tuple(begin + n for begin, n in zip(self.begins, samples, strict=True)),
            tuple(blow for blow in shifted if blow.sample > 0),
        )

    def every_blow(self) -> tuple[Blow, ...]:
        """Blows in samples of whole records, with those that begin records."""
        later = [Blow(blow.record, blow.sample + self.begins[blow.record]) for blow in self.blows]
        first = [Blow(record, begin) for record, begin in enumerate(self.begins) if begin]
        return tuple(sorted([*first, *later]))


def from_early_blows(struck: StruckRecords) -> StruckRecords:
    """Records from the last of their early blows on."""
    samples = [0] * len(struck.records)
    for blow in struck.blows:
        if blow.sample < EARLY * len(struck.records[blow.record]):
            samples[blow.record] = max(samples[blow.record], blow.sample)
    return struck.later(samples)


def from_rests(struck: StruckRecords, response: Response, errors: Lines) -> StruckRecords:
    """Records from the ends of early rests on, unless they begin at a blow already.

    There the variance of the `errors`, of one level, falls, by the Bayesian information criterion.
    """
    free = (response.band[1] - response.band[0]) / response.rate  # complex numbers of a sample
    samples = []
    for number, (length, begin) in enumerate(zip(response.lengths, struck.begins, strict=True)):
        sums = np.cumsum(energy_along(errors, number, length, response.rate))
        before = np.arange(1, max(int(EARLY * length), 2))
        after = length - before
        first, second = sums[before - 1] / before, (sums[-1] - sums[before - 1]) / after
        mean = max(sums[-1] / length, 1e-300)
        first, second = (np.maximum(part / mean, 1e-300) for part in (first, second))
        gain = -free * (before * np.log(first) + after * np.log(second))
        gain = np.where(first > second, gain, 0.0)
        best = int(np.argmax(gain))
        ends = not begin and gain[best] > np.log(2 * free * length)
        samples.append(int(before[best]) if ends else 0)
    return struck.later(samples)


def energy_along(
    errors: Lines, number: int, length: int, rate: float
) -> Float[np.ndarray, " time"]:
    """Energy of errors along a record of a `length` in samples, of all channels together."""
    these = errors.record == number
    spectrum = np.zeros((length // 2 + 1, errors.outputs.shape[1]), complex)
    spectrum[bins_of(errors, these, length, rate)] = errors.outputs[these]
    return np.sum(np.fft.irfft(spectrum, length, axis=0) ** 2, axis=1)
