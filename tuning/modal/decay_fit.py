"""Modes from a free decay: the window trimmed, the poles found, and what does not last left out."""

import numpy as np
from scipy.stats import t as student

from tuning.modal.decay_poles import Poles, Spectrum, find_poles, refine, transform
from tuning.modal.result import Findings, Mode, reason_against
from tuning.modal.window import in_band

LEAST_BINS = 8
PARTS = 16  # of a window; the first is cut while the rest does not predict it
LATE = 0.3
UNPREDICTED = 0.5  # share of the energy
STRONGEST = 6  # modes that predict
# A true mode is found again, within this many standard deviations, in parts of the window.
LASTING = 4.0
SHORTER = 0.2
WEAK = 0.2  # share of the strongest mode's energy
LOST = "not the same in parts of the window"


def fit_decay(values, rate: float, start: int, stop: int, band) -> Findings | None:
    """Identify modes from the free decay between two samples of a log (values: time, channel).

    A mode must be found again in the window without its first and without its last fifth; how
    far it moves there, beyond what noise explains, adds to its uncertainty (a real structure's
    frequency and damping depend a little on amplitude). None where the band has too few
    frequencies.
    """
    spectrum = transform(values[start:stop], rate, band)
    if spectrum.bins.size < LEAST_BINS:
        return None
    found = find_poles(spectrum)
    cut = int(SHORTER * (stop - start))
    shorter = [
        transform(values[first:last], rate, band)
        for first, last in ((start + cut, stop), (start, stop - cut))
    ]
    others = [_again(found, spectrum, other) for other in shorter]
    modes = _modes(found, _scatter(found, others), spectrum)
    reasons = [reason_against(mode, spectrum.duration, band) for mode in modes]
    lost = _lost(found, others, spectrum)
    return Findings(
        modes=modes,
        reasons=tuple(
            why or (LOST if gone else "") for gone, why in zip(lost, reasons, strict=True)
        ),
        start=start,
        stop=stop,
        quantile=float(student.ppf(0.975, max(found.freedom, 3.0))),
        measured=in_time(found.model + found.residual, spectrum),
        fitted=in_time(found.model, spectrum),
    )


def free_part(values, rate: float, start: int, stop: int, band) -> tuple[int, int]:
    """The samples around a decay, roughly known, in which its modes predict what is measured.

    The beginning is cut, in coarse steps and then in fine ones, while the modes of the later part
    do not predict it backwards: there something still excites the structure. The end is moved on
    while they predict what follows.
    """
    for part in (max((stop - start) // PARTS, 1), max((stop - start) // (4 * PARTS), 1)):
        while stop - start > PARTS // 2 * part:
            late = start + int(LATE * (stop - start))
            if _unpredicted(values, rate, (late, stop), (start, start + part), band) < UNPREDICTED:
                break
            start += part
    part = max((stop - start) // PARTS, 1)
    while stop + part <= len(values):
        if _unpredicted(values, rate, (start, stop), (stop, stop + part), band) > UNPREDICTED:
            break
        stop += part
    return start, stop


def _unpredicted(values, rate, known, wanted, band) -> float:
    """Share of the energy of the samples `wanted` that modes of the samples `known` do not make."""
    spectrum = transform(values[known[0] : known[1]], rate, band)
    if spectrum.bins.size < LEAST_BINS:
        return 0.0
    found = find_poles(spectrum, most=STRONGEST)
    times = (np.arange(*wanted) - known[0]) / rate
    predicted = (np.exp(np.multiply.outer(times, found.poles)) @ found.amplitudes).real
    # Filtered with what follows, if anything does, for a filter is unsure at the ends.
    first, last = min(known[0], wanted[0]), max(known[1], 2 * wanted[1] - wanted[0])
    measured = in_band(values[first:last], rate, band)[wanted[0] - first : wanted[1] - first]
    return float(np.sum((measured - predicted) ** 2) / np.sum(measured**2))


def in_time(values, spectrum: Spectrum):
    """Samples (sample, channel) of the bins of a spectrum."""
    whole = np.zeros((spectrum.samples // 2 + 1, values.shape[1]), complex)
    first = round(spectrum.bins[0] * spectrum.duration)
    whole[first : first + len(values)] = values
    return np.fft.irfft(whole, spectrum.samples, axis=0)


def _lost(found: Poles, others, spectrum: Spectrum):
    """Tell which poles are not the same in shorter windows; the strongest are in any case.

    A weak pole beside a strong one often makes up for what is not linear in the strong one: it
    stays in the fit, where it does that, but is no mode.
    """
    moved = np.zeros(found.poles.size)
    for other in others:
        deviation = np.sqrt(np.diag(found.covariance) + np.diag(other.covariance))
        change = np.abs(_pairs(other.poles) - _pairs(found.poles)) / deviation
        moved = np.maximum(moved, np.max(change.reshape(-1, 2), axis=1))
        moved[other.poles.real > 0] = np.inf
    share = _shares(found, spectrum)
    return (moved > LASTING) & (share < WEAK * np.max(share, initial=0.0))


def _again(found: Poles, spectrum: Spectrum, other: Spectrum) -> Poles:
    """The same poles refined on another window, with the noise level of the first."""
    levels = [np.interp(other.bins, spectrum.bins, level) for level in found.noise.T]
    return refine(found.poles, other, np.stack(levels, 1) * other.samples / spectrum.samples)


def _pairs(poles):
    """(s, w) of each pole, in the order of its covariance."""
    return np.stack([-poles.real, poles.imag], axis=1).ravel()


def _scatter(found: Poles, others):
    """Variance of each of (s, w, ...) over the window, beyond what noise explains.

    As if they were spread evenly over the range seen: a third of the square of half the range.
    """
    extra = np.zeros(2 * found.poles.size)
    for other in others:
        expected = np.maximum(np.diag(other.covariance) - np.diag(found.covariance), 0)
        change = (_pairs(other.poles) - _pairs(found.poles)) ** 2
        extra += np.where(change > 4 * expected, change - expected, 0) / 3 / len(others)
    return extra


def _shares(found: Poles, spectrum: Spectrum):
    """Share of each mode in the energy of the samples, the channels' energies added."""
    rates = 2 * -found.poles.real * spectrum.duration
    lasting = np.where(np.abs(rates) < 1e-6, 1.0, -np.expm1(-rates) / np.where(rates, rates, 1))
    energies = 0.5 * np.sum(np.abs(found.amplitudes) ** 2, axis=1) * lasting
    total = 2 * np.sum(np.abs(found.model + found.residual) ** 2) / spectrum.samples**2
    return energies / total


def _modes(found: Poles, scatter, spectrum: Spectrum) -> tuple[Mode, ...]:
    """Frequency and damping of each pole, |p| / 2 pi and s / |p|, with standard deviations."""
    modes = []
    for k, (pole, share) in enumerate(zip(found.poles, _shares(found, spectrum), strict=True)):
        covariance = found.covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        covariance = covariance + np.diag(scatter[2 * k : 2 * k + 2])
        rate, turn, size = -pole.real, pole.imag, abs(pole)
        by_frequency = np.array([rate, turn]) / size / (2 * np.pi)
        by_damping = np.array([turn**2, -rate * turn]) / size**3
        modes.append(
            Mode(
                frequency=float(size / (2 * np.pi)),
                frequency_sd=float(np.sqrt(by_frequency @ covariance @ by_frequency)),
                damping_ratio=float(rate / size),
                damping_sd=float(np.sqrt(by_damping @ covariance @ by_damping)),
                share=float(share),
            )
        )
    return tuple(modes)
