"""Harmonic lines of motors, shakers and mains hum: found, named and subtracted.

A line is found by the F-test of several tapers (Thomson 1982; Percival and Walden 1993, section
10.11): its power exceeds that of the continuous spectrum within the bandwidth of the tapers. It
must have the same amplitude and phase throughout the record, which a resonance has not, nor one
decay of a lightly damped mode.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.signal.windows import dpss
from scipy.stats import f as f_distribution

from tuning.modal.ambient import Candidate
from tuning.modal.preprocessing import Samples, energy_band, prepare
from tuning.modal.result import IdentifiedMode

TAPERS, TIME_BANDWIDTH = 7, 4.0  # of the F-test (Thomson 1982), of 2 * 4 - 1 good tapers
FALSE_ALARM_PROBABILITY = 1e-3  # of a line in noise, in a whole spectrum
PARTS = 8  # parts of a record in which a line is followed
MIN_COHERENCE = 0.9  # length of the mean of its complex amplitudes over their rms
MIN_FALL, FALL_SDS = 0.1, 4.0  # nepers over a record, and standard deviations, of a decay
RAYLEIGH_RATIO = 0.5227  # deviation over mean of the envelope of a random vibration
# Deviation of its estimate from one decay time, and limit in these: of 3000 random vibrations each,
# over 12 to 100 decay times, 0.38 to 0.43 over the root of their number. Below the limit for doubt
# are one in a hundred, below that for a line one in two thousand: a mode that is lost is worse.
RATIO_SD, DOUBTFUL_SDS, STEADY_SDS = 0.43, 2.3, 3.3
STEADY_RATIO = 0.35  # of the envelope of a line in noise of a tenth of its power
HALF_POWER_WIDTHS = 4.0  # half width of the filter around a pole
MAX_LINES = 100  # largest number of lines, the strongest ones
MIN_SERIES = 3  # lines that are multiples of one frequency


class Line(NamedTuple):
    """A harmonic line: frequency (Hz) and its fraction (`share`) of the variance of the record.

    `pole` (1/s) is that of a line that wanders and was taken for a mode; other lines are subtracted
    before modes are sought.
    """

    frequency: float
    share: float
    pole: complex | None = None


def harmonic_lines(
    record: Float[np.ndarray, "time channel"], rate: float, band: tuple[float, float]
) -> tuple[Line, ...]:
    """Lines in a record within a band (Hz), ascending in frequency."""
    count, channels = record.shape
    if count < 16 * TAPERS:
        return ()
    tapers = dpss(count, TIME_BANDWIDTH, TAPERS)
    size = 1 << int(np.ceil(np.log2(2 * count)))
    bins = np.fft.rfftfreq(size, 1 / rate)
    inside = (bins > band[0]) & (bins < band[1])
    level = tapers.sum(axis=1)
    level[1::2] = 0.0  # those of odd tapers vanish
    limit = f_distribution.isf(
        FALSE_ALARM_PROBABILITY / (channels * max(np.sum(inside) // 2, 1)), 2, 2 * TAPERS - 2
    )
    found: list[float] = []
    variance = np.maximum(record.var(axis=0), 1e-300)
    for channel in range(channels):
        spectra = np.fft.rfft(tapers * record[:, channel], size, axis=1)
        power, ratio = _line_test(spectra, level)
        peak = (power > np.roll(power, 1)) & (power >= np.roll(power, -1))
        # Between two bins the ratio of a line is smaller: it is computed again at its frequency.
        found += bins[inside & peak & (ratio > limit / 10)].tolist()
    lines: list[float] = []
    times = np.arange(count) / rate
    for frequency in sorted(found):
        if any(abs(frequency - f) <= 2 * rate / count for f in lines):
            continue
        refined = _followed(record, rate, frequency, variance)
        if refined is None or any(abs(refined - f) <= 2 * rate / count for f in lines):
            continue
        shifted = record * np.exp(-2j * np.pi * refined * times)[:, None]
        if np.max(_line_test(tapers @ shifted, level)[1]) > limit:
            lines.append(refined)
    shares = [share_of(record, rate, f) for f in lines]
    ranked = sorted(zip(shares, lines, strict=True), reverse=True)[:MAX_LINES]
    return tuple(sorted(Line(f, share) for share, f in ranked))


def fundamental(lines: tuple[Line, ...], rate: float, count: int) -> float | None:
    """Frequency (Hz) of which most lines of a record of `count` samples are multiples, or None.

    They are at least three, and within half of the resolution of the record.
    """
    frequencies = np.array([line.frequency for line in lines])
    for first in frequencies:
        multiples = np.round(frequencies / first)
        near = np.abs(frequencies - multiples * first) < multiples * 0.5 * rate / count
        if first > 2 * rate / count and near.sum() >= max(MIN_SERIES, 0.5 * len(lines)):
            weights = multiples[near]
            return float(weights @ frequencies[near] / (weights @ weights))
    return None


def is_multiple(frequency: float, tolerance: float, speed: float | None) -> bool:
    """Whether a frequency (Hz) is that of a higher harmonic of a speed (Hz), if there is one."""
    if speed is None:
        return False
    return abs(frequency - max(round(frequency / speed), 1) * speed) < tolerance


def share_of(record: Float[np.ndarray, "time channel"], rate: float, frequency: float) -> float:
    """Fraction of the variance of a record in a sinusoid (Hz), on average over channels."""
    amplitude = _amplitudes(record, rate, frequency, 1)[0]
    return float(np.mean(np.abs(amplitude) ** 2 / 2 / np.maximum(record.var(axis=0), 1e-300)))


def _line_test(spectra, level):
    """Power of a line at each frequency, and its ratio to the rest within the tapers' bandwidth."""
    norm = np.sum(level**2)
    amplitude = level @ spectra / norm
    rest = np.sum(np.abs(spectra - np.multiply.outer(level, amplitude)) ** 2, axis=0)
    power = np.abs(amplitude) ** 2
    return power, (TAPERS - 1) * power * norm / np.maximum(rest, 1e-300)


def _amplitudes(record, rate, frequency, parts):
    """Complex amplitudes of a line in equal parts of a record (part, channel), by Hann windows."""
    size = len(record) // parts
    window, turn = np.hanning(size), -2j * np.pi * frequency / rate
    # Parts differ by a phase: the exponentials of one serve all.
    kernel = window * np.exp(turn * np.arange(size))
    pieces = record[: size * parts].reshape(parts, size, -1)
    sums = np.stack([kernel.real, kernel.imag]) @ pieces
    phases = np.exp(turn * size * np.arange(parts))
    return 2 * phases[:, None] * (sums[:, 0] + 1j * sums[:, 1]) / window.sum()


def _followed(record, rate, frequency, variance) -> float | None:
    """The frequency refined by the phase from part to part; None if the line does not last."""
    size = len(record) // PARTS
    step = size / rate
    for _ in range(3):
        z = _amplitudes(record, rate, frequency, PARTS)
        channel = int(np.argmax(np.sum(np.abs(z) ** 2, axis=0) / variance))
        product = np.sum(z[1:, channel] * z[:-1, channel].conj())
        change = np.angle(product) / (2 * np.pi * step)
        frequency += change
    z = _amplitudes(record, rate, frequency, PARTS)[:, channel]
    coherence = np.abs(np.mean(z)) / np.sqrt(np.mean(np.abs(z) ** 2))
    lasts = coherence > MIN_COHERENCE and not _falls(np.abs(z))
    return float(frequency) if lasts else None


def _falls(sizes):
    """Whether amplitudes from part to part fall, beyond their scatter, as those of a decay."""
    across = np.arange(sizes.size) - (sizes.size - 1) / 2
    level = np.log(np.maximum(sizes, 1e-300))
    slope = across @ level / (across @ across)
    scatter = np.sum((level - level.mean() - slope * across) ** 2) / (sizes.size - 2)
    deviation = np.sqrt(scatter / (across @ across))
    return slope * sizes.size < -MIN_FALL and slope < -FALL_SDS * deviation


def steadiness(
    record: Float[np.ndarray, "time channel"], rate: float, frequency: float, damping_ratio: float
) -> float:
    """Steadiness of the vibration at a pole compared with a resonance, in standard deviations.

    The envelope of a resonance under random excitation has Rayleigh's distribution, with a ratio of
    deviation to mean of 0.52 (a kurtosis of 3 of the vibration; Jacobsen, Andersen and Brincker
    2007), estimated from as many decay times as the record has. That of a machine, though its speed
    may wander, is steady. Zero where the ratio is above what a line in noise has.
    """
    independent = 2 * np.pi * damping_ratio * frequency * len(record) / rate
    transform = np.fft.fft(record, axis=0)
    bins = np.fft.fftfreq(len(record), 1 / rate)
    half = HALF_POWER_WIDTHS * damping_ratio * frequency
    transform *= np.where(
        np.abs(bins - frequency) < half, np.cos(np.pi * (bins - frequency) / half / 2) ** 2, 0.0
    )[:, None]
    channel = int(np.argmax(np.sum(np.abs(transform) ** 2, axis=0) / record.var(axis=0)))
    envelope = np.abs(np.fft.ifft(transform[:, channel]))
    ratio = envelope.std() / max(envelope.mean(), 1e-300)
    if ratio > STEADY_RATIO:
        return 0.0
    return float((RAYLEIGH_RATIO - ratio) * np.sqrt(independent) / RATIO_SD)


def without_lines(
    record: Float[np.ndarray, "time channel"], rate: float, frequencies: tuple[float, ...]
) -> Float[np.ndarray, "time channel"]:
    """The record less the sinusoids of some frequencies (Hz), fitted by least squares."""
    if not frequencies:
        return record
    phases = 2 * np.pi * np.multiply.outer(np.arange(len(record)) / rate, frequencies)
    basis = np.concatenate([np.cos(phases), np.sin(phases)], axis=1)
    return record - basis @ np.linalg.lstsq(basis, record, rcond=None)[0]


def subtract_lines(
    samples: Samples, band: tuple[float, float], exclude: Sequence[float]
) -> tuple[tuple[Line, ...], tuple[Float[np.ndarray, "_ channel"], ...]]:
    """Harmonic lines in a band (Hz), and the records without them and excluded frequencies (Hz)."""
    prepared = prepare(samples.records, samples.starts, samples.rate, band)
    longest = max(range(len(samples.records)), key=lambda i: len(samples.records[i]))
    lines = harmonic_lines(prepared.records[longest], prepared.rate, band)
    frequencies = tuple(line.frequency for line in lines) + tuple(exclude)
    centred = (record - record.mean(axis=0) for record in samples.records)
    return lines, tuple(without_lines(one, samples.rate, frequencies) for one in centred)


def band_without_lines(
    samples: Samples,
    derivatives: tuple[int, ...],
    exclude: Sequence[float],
    band: tuple[float, float] | None,
) -> tuple[tuple[float, float], tuple[Line, ...], tuple[Float[np.ndarray, "_ channel"], ...]]:
    """The band (Hz), the harmonic lines in it, and the records without them.

    A band that is not given is that of the energy of the readings and of the kinetic energy;
    `derivatives` are the orders of the channels as time derivatives.
    """
    used = band or band_of(energy_band, samples, derivatives)
    lines, cleaned = subtract_lines(samples, used, exclude)
    if lines and band is None:
        used = band_of(energy_band, samples, derivatives, cleaned)
        lines, cleaned = subtract_lines(samples, used, exclude)
    return used, lines, cleaned


def band_of(
    measure: Callable,
    samples: Samples,
    derivatives: tuple[int, ...],
    cleaned: tuple[Float[np.ndarray, "_ channel"], ...] | None = None,
) -> tuple[float, float]:
    """Band (Hz) of resonances by a `measure`, with that of the records `cleaned` of lines, if any.

    Strong lines hold most of the energy, but resonances decide the band.
    """
    bands = [measure(samples.records, samples.rate, derivatives)]
    if cleaned is not None:
        bands.append(measure(cleaned, samples.rate, derivatives))
    return min(low for low, _ in bands), max(high for _, high in bands)


def lines_besides(lines: tuple[Line, ...], modes: Sequence[IdentifiedMode]) -> tuple[Line, ...]:
    """Harmonic lines without those that are modes of free decays.

    After impacts at equal intervals a mode of little damping may look like a line.
    """
    return tuple(
        line
        for line in lines
        if not any(abs(line.frequency / m.frequency - 1) < 2 * m.damping_ratio for m in modes)
    )


def steady_candidates(
    candidates: Sequence[Candidate],
    cleaned: tuple[Float[np.ndarray, "_ channel"], ...],
    samples: Samples,
    band: tuple[float, float],
) -> tuple[tuple[Line, ...], tuple[float, ...]]:
    """Candidates that are lines of machines whose speed wanders, and frequencies (Hz) of others.

    The latter may be such lines or resonances.
    """
    record = max(prepare(cleaned, samples.starts, samples.rate, band).records, key=len)
    rate = samples.rate * len(record) / max(map(len, cleaned))
    lines, doubtful = [], []
    for candidate in candidates:
        mode = candidate.mode
        if mode.damping_ratio <= 0:
            continue
        deviations = steadiness(record, rate, mode.frequency, mode.damping_ratio)
        if deviations > STEADY_SDS:
            lines.append(Line(mode.frequency, min(mode.energy_share, 1.0), mode.pole))
        elif deviations > DOUBTFUL_SDS and not candidate.reason:
            doubtful.append(mode.frequency)
    return tuple(lines), tuple(doubtful)
