"""Cross-spectral matrices of records by Welch's method, in groups of segments."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

SEGMENTS = 24  # segments of half their length apart, in all records, if these are long enough
GROUPS = 12  # groups of neighbouring segments, each left out in turn for uncertainties
MIN_SEGMENT = 64


class CrossSpectra(NamedTuple):
    """Sums over groups of segments: power spectral densities (group, bin, channel, channel).

    Each group is divided by the number of all segments, so that their sum is the mean. Segments
    have `size` samples, padded to twice as many with zeros, and a window of Hann.
    """

    bins: Float[np.ndarray, " bin"]
    groups: Complex[np.ndarray, "group bin channel channel"]
    rate: float
    size: int

    @property
    def mean(self) -> Complex[np.ndarray, "bin channel channel"]:
        """Cross-spectral matrix, averaged over all segments."""
        return self.groups.sum(axis=0)

    @property
    def correlation_window(self) -> Float[np.ndarray, " lag"]:
        """Window that the correlations have by that of the segments, from lag 0 to `size` - 1."""
        transform = np.fft.rfft(_window(self.size), 2 * self.size)
        return np.fft.irfft(np.abs(transform) ** 2, 2 * self.size)[: self.size]


def _window(size):
    return np.hanning(size + 1)[:-1]


def cross_spectra(
    records: tuple[Float[np.ndarray, "time channel"], ...], rate: float
) -> CrossSpectra:
    """Cross-spectral matrices of all records, of about 24 segments that overlap by half."""
    total = sum(map(len, records))
    size = 2 * total // (SEGMENTS + 1)
    size = max(min(size, max(map(len, records))), MIN_SEGMENT) // 2 * 2
    starts = [
        (record, first)
        for record in records
        for first in range(0, len(record) - size + 1, size // 2)
    ]
    window = _window(size)
    scale = 2 / (rate * np.sum(window**2) * len(starts))  # one-sided
    shares = np.array_split(np.arange(len(starts)), min(GROUPS, len(starts)))
    groups = []
    for share in shares:
        total = 0.0
        for record, first in (starts[i] for i in share):
            segment = record[first : first + size]
            spectrum = np.fft.rfft((segment - segment.mean(axis=0)) * window[:, None], 2 * size, 0)
            total = total + spectrum[:, :, None] * spectrum[:, None, :].conj()
        groups.append(scale * total)
    bins = np.fft.rfftfreq(2 * size, 1 / rate)
    return CrossSpectra(bins, np.stack(groups), rate, size)
