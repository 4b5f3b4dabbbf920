"""Enhanced frequency-domain decomposition (EFDD).

Singular values of the cross-spectral matrix peak at natural frequencies, where the first singular
vector is the mode shape (Brincker, Zhang and Andersen 2001). Around a peak the spectrum of one mode
is that along its shape, as far as a singular vector of each bin resembles it (MAC). Its inverse
Fourier transform is the correlation of a single mode: zero crossings tell its frequency, the
logarithmic decrement of its extremes its damping ratio (Brincker, Ventura and Andersen 2001). The
window of the segments multiplies correlations and is divided out, so that it does not damp.

Two modes closer than their bells show one peak. What is orthogonal to the shape at it is then a
spectrum of the other mode alone: its peak is that of the second singular value. Along the part of
the first shape that is orthogonal to the second, the spectrum is that of the first.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from tuning.modal.preprocessing import resonance_excess
from tuning.modal.shapes import mac_matrix
from tuning.modal.spectral.cross_spectra import CrossSpectra

MIN_MAC = 0.8  # of a singular vector in the bell of a mode with the shape at its peak
MAX_RISE = 4.0  # of the spectrum beyond its least value on the way from the peak: a bell ends there
HIGHEST, LOWEST = 0.95, 0.2  # of the envelope of the correlation, between which it is evaluated
MAX_WINDOW_LOSS = 0.1  # of the window of correlations, below which lags are not used
MIN_FALL = 3.0  # of the spectrum from a peak to both ends of its bell: less is chance
MIN_EXTREMES = 4
PEAK_BINS = 2  # by which the highest bin of a peak exceeds its neighbours


class Bell(NamedTuple):
    """Bins (first, last exclusive) around a peak that belong to one mode, and its shape.

    `along` is the vector along which the spectrum is that of this mode alone: the shape, or for
    one of a pair the part of it that the other has not.
    """

    peak: int
    first: int
    last: int
    shape: Complex[np.ndarray, " channel"]
    along: Complex[np.ndarray, " channel"]
    of_pair: bool = False


class SingleMode(NamedTuple):
    """Undamped natural frequency (Hz) and damping ratio of a correlation of one mode."""

    frequency: float
    damping_ratio: float


def singular_values(
    spectra: Complex[np.ndarray, "bin channel channel"],
) -> tuple[Float[np.ndarray, "bin value"], Complex[np.ndarray, "bin value channel"]]:
    """Singular values of cross-spectral matrices, the largest first, and singular vectors."""
    values, vectors = np.linalg.eigh(spectra)
    return values[:, ::-1], np.swapaxes(vectors, 1, 2)[:, ::-1]


def bells(spectra: CrossSpectra, band: tuple[float, float]) -> tuple[Bell, ...]:
    """Peaks of the first singular value that stand out in a band (Hz), and their bells.

    The highest come first; a peak in the bell of a higher one is that mode again.
    """
    values, vectors = singular_values(spectra.mean)
    inside = np.flatnonzero((spectra.bins >= band[0]) & (spectra.bins <= band[1]))
    if inside.size < 8:
        return ()
    first_value = values[inside, 0]
    excess = resonance_excess(spectra.bins[inside], first_value[:, None])[:, 0]
    neighbours = np.stack([np.roll(first_value, k) for k in range(-PEAK_BINS, PEAK_BINS + 1) if k])
    tops = inside[(excess > 0) & np.all(first_value > neighbours, axis=0)]
    found: list[Bell] = []
    for peak in sorted(tops.tolist(), key=lambda k: -values[k, 0]):
        shape = vectors[peak, 0]
        known = any(
            one.first <= peak < one.last and _mac(shape, one.shape) > MIN_MAC for one in found
        )
        if not known:
            found.append(_bell(spectra, vectors, peak, shape, inside))
    found = [one for one in found if _falls(spectra, one)]
    for one in tuple(found):
        partner = _partner(spectra, one, inside)
        known = partner is None or any(
            other.first <= partner.peak < other.last and _mac(other.shape, partner.shape) > MIN_MAC
            for other in found
        )
        if partner is not None and not known:
            place = next(k for k, other in enumerate(found) if other is one)
            found[place] = _apart(spectra, one, partner.shape, inside)
            found.append(partner)
    return tuple(found)


def _partner(spectra, bell, inside) -> Bell | None:
    """The other mode of a pair: a peak within a bell of the spectrum without the bell's shape.

    Its shape is the response with its part that is orthogonal to the other shape: the sum of
    cross-spectra G v over its bell.
    """
    if bell.shape.size < 2:
        return None
    rest = np.eye(bell.shape.size) - np.outer(bell.shape, bell.shape.conj())
    values, vectors = singular_values(rest @ spectra.mean @ rest)
    level = values[:, 0]
    excess = np.zeros(level.size)
    excess[inside] = resonance_excess(spectra.bins[inside], level[inside, None])[:, 0]
    # The other's own bell begins where the shape ceases.
    low, high = 2 * bell.first - bell.peak, 2 * bell.last - bell.peak
    window = np.arange(max(low, inside[0]), min(high, inside[-1]))
    shifts = [k for k in range(-PEAK_BINS, PEAK_BINS + 1) if k]
    highest = np.all(level > np.stack([np.roll(level, k) for k in shifts]), axis=0)
    tops = window[(excess[window] > 0) & highest[window]]
    if not tops.size:
        return None
    peak = int(tops[np.argmax(level[tops])])
    along = vectors[peak, 0]
    first, last = _edges(spectra, along, peak, inside)
    shape = np.sum(spectra.mean[first:last], axis=0) @ along
    found = Bell(peak, first, last, shape / np.linalg.norm(shape), along, of_pair=True)
    return found if _falls(spectra, found) else None


def _apart(spectra, bell, other, inside) -> Bell:
    """A bell along the part of its shape that the other of a pair has not."""
    along = bell.shape - other * (other.conj() @ bell.shape)
    along = along / np.linalg.norm(along)
    density = along_shape(spectra.mean, along)
    around = np.arange(max(bell.peak - PEAK_BINS, 0), bell.peak + PEAK_BINS + 1)
    peak = int(around[np.argmax(density[around])])
    first, last = _edges(spectra, along, peak, inside)
    return bell._replace(peak=peak, first=first, last=last, along=along)


def _falls(spectra, bell):
    """Whether the spectrum falls enough on both sides of a peak within its bell."""
    along = along_shape(spectra.mean, bell.along)
    sides = along[bell.first : bell.peak + 1].min(), along[bell.peak : bell.last].min()
    return along[bell.peak] > MIN_FALL * max(sides)


def _mac(a, b):
    return mac_matrix(a[None], b[None])[0, 0]


def _bell(spectra, vectors, peak, shape, inside) -> Bell:
    """Bins on both sides of a peak, as far as a singular vector resembles its shape."""
    similar = np.max(
        np.abs(vectors @ shape.conj()) ** 2 / np.sum(np.abs(vectors) ** 2, axis=2), axis=1
    )
    first, last = _edges(spectra, shape, peak, inside, similar > MIN_MAC)
    return Bell(peak, first, last, shape, shape)


def _edges(spectra, vector, peak, inside, allowed=None):
    """First and last bin (exclusive) of the bell around a peak of the spectrum along a vector."""
    along = along_shape(spectra.mean, vector)
    edges = []
    for step, limit in ((-1, inside[0]), (1, inside[-1])):
        k, least = peak, along[peak]
        while k != limit:
            k += step
            if (allowed is not None and not allowed[k]) or along[k] > MAX_RISE * least:
                break
            least = min(least, along[k])
        edges.append(int(k))
    return edges[0], edges[1] + 1


def along_shape(
    spectra: Complex[np.ndarray, "*group bin channel channel"],
    shape: Complex[np.ndarray, " channel"],
) -> Float[np.ndarray, "*group bin"]:
    """Power spectral densities of the coordinate shape^H y."""
    return np.real(np.einsum("...ij,i,j->...", spectra, shape.conj(), shape))


def single_mode(
    density: Float[np.ndarray, " bin"],
    bell: Bell,
    rate: float,
    window: Float[np.ndarray, " lag"],
) -> SingleMode | None:
    """Frequency and damping ratio of the mode whose spectral density fills a bell.

    `window` is that of the correlations. None if they have too few extremes to evaluate.
    """
    part = np.zeros(density.size)
    part[bell.first : bell.last] = density[bell.first : bell.last]
    correlation = np.fft.irfft(part)[: window.size]
    usable = int(np.argmax(window < MAX_WINDOW_LOSS * window[0])) or window.size
    correlation = correlation[:usable] / window[:usable]
    return decrement(correlation / correlation[0], rate)


def decrement(correlation: Float[np.ndarray, " lag"], rate: float) -> SingleMode | None:
    """Frequency by zero crossings, damping by logarithmic decrement, of one mode's correlation.

    Extremes between 95 % and 20 % of the first value are used: the slope of the logarithm of their
    size over time is -z w, that of the crossings over their number half a damped period.
    """
    size = np.abs(correlation)
    turns = np.flatnonzero((size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:])) + 1
    times, sizes = _vertices(correlation, turns)
    low = np.flatnonzero(sizes < LOWEST)
    keep = np.arange(sizes.size) < (low[0] if low.size else sizes.size)
    keep &= sizes <= HIGHEST
    if keep.sum() < MIN_EXTREMES:
        return None
    times, sizes = times[keep], sizes[keep]
    rate_of_decay = -np.polyfit(times, np.log(sizes), 1)[0] * rate
    signs = np.flatnonzero(correlation[:-1] * correlation[1:] < 0)
    crossings = signs + correlation[signs] / (correlation[signs] - correlation[signs + 1])
    crossings = crossings[crossings < times[-1]]
    half_period = np.polyfit(np.arange(crossings.size), crossings, 1)[0] / rate
    damped = np.pi / half_period
    natural = np.hypot(damped, rate_of_decay)
    return SingleMode(float(natural / (2 * np.pi)), float(rate_of_decay / natural))


def _vertices(values, turns):
    """Places and sizes of extremes, by parabolas through three samples each."""
    before, top, after = (np.abs(values[turns + k]) for k in (-1, 0, 1))
    curve = before - 2 * top + after
    shift = np.where(curve < 0, 0.5 * (before - after) / np.where(curve < 0, curve, 1), 0.0)
    return turns + shift, top - 0.25 * (before - after) * shift
