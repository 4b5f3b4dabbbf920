"""Modes from a free decay: window, poles, and rejection of poles that are not reproduced."""

import numpy as np
from scipy.stats import t as student

from tuning.modal.decay_poles import (
    PoleFit,
    Spectrum,
    band_spectrum,
    find_poles,
    pole_parameters,
    refine,
)
from tuning.modal.result import IdentifiedMode, ModeCandidates, rejection_reason
from tuning.modal.window import band_pass

MIN_BINS = 8  # bins of a spectrum to find poles in
TRIM_PARTS = 16  # parts of a window, by which it is shortened or extended
LATE_START_SHARE = 0.3  # of a window, after which its modes must predict its first part
MAX_UNPREDICTED_ENERGY = 0.5  # share of the energy of a part that belongs to the decay
MAX_PREDICTING_MODES = 6  # modes for predictions
MAX_POLE_SHIFT_SD = 4.0  # standard deviations by which a pole may differ in a shorter window
SHORTER_WINDOW_CUT = 0.2  # share of the window that is cut off for a shorter one
WEAK_ENERGY_SHARE = 0.2  # of the strongest mode's energy; below it poles must be reproduced
NOT_REPRODUCED = "not the same in parts of the window"


def fit_decay(values, rate: float, start: int, stop: int, band) -> ModeCandidates | None:
    """Modes from the free decay between two samples of a log (values: time, channel).

    A weak mode must be reproduced in the window without its first and without its last fifth. The
    change of a pole there, beyond what noise explains, adds to its uncertainty (frequency and
    damping of a real structure depend slightly on amplitude). None if the band has too few bins.
    """
    spectrum = band_spectrum(values[start:stop], rate, band)
    if spectrum.bins.size < MIN_BINS:
        return None
    found = find_poles(spectrum)
    cut = int(SHORTER_WINDOW_CUT * (stop - start))
    shorter_spectra = [
        band_spectrum(values[first:last], rate, band)
        for first, last in ((start + cut, stop), (start, stop - cut))
    ]
    shorter_fits = [_refit(found, spectrum, other) for other in shorter_spectra]
    modes = _identified_modes(found, _nonstationary_variance(found, shorter_fits), spectrum)
    reasons = [rejection_reason(mode, spectrum.duration, band) for mode in modes]
    not_reproduced = _not_reproduced(found, shorter_fits, spectrum)
    return ModeCandidates(
        modes=modes,
        rejection_reasons=tuple(
            why or (NOT_REPRODUCED if gone else "")
            for gone, why in zip(not_reproduced, reasons, strict=True)
        ),
        start=start,
        stop=stop,
        quantile=float(student.ppf(0.975, max(found.degrees_of_freedom, 3.0))),
        measured=inverse_transform(found.model + found.residual, spectrum),
        fitted=inverse_transform(found.model, spectrum),
    )


def trim_to_free_decay(values, rate: float, start: int, stop: int, band) -> tuple[int, int]:
    """Range of samples (start, stop) around a roughly known decay that is free of excitation.

    The beginning is cut, in coarse steps and then in fine ones, as long as the modes of the later
    part do not predict it backwards. The end is moved on as long as they predict the next samples.
    """
    for part in (max((stop - start) // TRIM_PARTS, 1), max((stop - start) // (4 * TRIM_PARTS), 1)):
        while stop - start > TRIM_PARTS // 2 * part:
            late = start + int(LATE_START_SHARE * (stop - start))
            if (
                _unpredicted_energy(values, rate, (late, stop), (start, start + part), band)
                < MAX_UNPREDICTED_ENERGY
            ):
                break
            start += part
    part = max((stop - start) // TRIM_PARTS, 1)
    while stop + part <= len(values):
        if (
            _unpredicted_energy(values, rate, (start, stop), (stop, stop + part), band)
            > MAX_UNPREDICTED_ENERGY
        ):
            break
        stop += part
    return start, stop


def _unpredicted_energy(values, rate, fitted_range, predicted_range, band) -> float:
    """Share of the energy of predicted samples that modes of the fitted ones do not explain."""
    spectrum = band_spectrum(values[fitted_range[0] : fitted_range[1]], rate, band)
    if spectrum.bins.size < MIN_BINS:
        return 0.0
    found = find_poles(spectrum, max_modes=MAX_PREDICTING_MODES)
    times = (np.arange(*predicted_range) - fitted_range[0]) / rate
    predicted = (np.exp(np.multiply.outer(times, found.poles)) @ found.amplitudes).real
    # Filtered together with the samples that follow: a filter is inaccurate at the ends.
    first, last = (
        min(fitted_range[0], predicted_range[0]),
        max(fitted_range[1], 2 * predicted_range[1] - predicted_range[0]),
    )
    measured = band_pass(values[first:last], rate, band)[
        predicted_range[0] - first : predicted_range[1] - first
    ]
    return float(np.sum((measured - predicted) ** 2) / np.sum(measured**2))


def inverse_transform(values, spectrum: Spectrum):
    """Samples (sample, channel) from values at the bins of a spectrum; zero at all others."""
    whole = np.zeros((spectrum.samples // 2 + 1, values.shape[1]), complex)
    first = round(spectrum.bins[0] * spectrum.duration)
    whole[first : first + len(values)] = values
    return np.fft.irfft(whole, spectrum.samples, axis=0)


def _not_reproduced(found: PoleFit, others, spectrum: Spectrum):
    """Which weak poles differ in shorter windows (mode,).

    A weak pole beside a strong one often stands for the nonlinearity of the strong one: it stays in
    the fit, but is no mode.
    """
    moved = np.zeros(found.poles.size)
    for other in others:
        deviation = np.sqrt(np.diag(found.covariance) + np.diag(other.covariance))
        change = np.abs(pole_parameters(other.poles) - pole_parameters(found.poles)) / deviation
        moved = np.maximum(moved, np.max(change.reshape(-1, 2), axis=1))
        moved[other.poles.real > 0] = np.inf
    share = _energy_shares(found, spectrum)
    return (moved > MAX_POLE_SHIFT_SD) & (share < WEAK_ENERGY_SHARE * np.max(share, initial=0.0))


def _refit(found: PoleFit, spectrum: Spectrum, other: Spectrum) -> PoleFit:
    """The poles refined on another window, with the noise level of the first."""
    levels = [np.interp(other.bins, spectrum.bins, level) for level in found.noise.T]
    return refine(found.poles, other, np.stack(levels, 1) * other.samples / spectrum.samples)


def _nonstationary_variance(found: PoleFit, others):
    """Variance of (s, w) of each pole over the window, beyond what noise explains.

    For a uniform distribution over the range seen: a third of the square of half the range.
    """
    extra = np.zeros(2 * found.poles.size)
    for other in others:
        expected = np.maximum(np.diag(other.covariance) - np.diag(found.covariance), 0)
        change = (pole_parameters(other.poles) - pole_parameters(found.poles)) ** 2
        extra += np.where(change > 4 * expected, change - expected, 0) / 3 / len(others)
    return extra


def _energy_shares(found: PoleFit, spectrum: Spectrum):
    """Share of each mode in the energy of the samples, added over channels."""
    rates = 2 * -found.poles.real * spectrum.duration
    decay_factor = np.where(
        np.abs(rates) < 1e-6, 1.0, -np.expm1(-rates) / np.where(rates, rates, 1)
    )
    energies = 0.5 * np.sum(np.abs(found.amplitudes) ** 2, axis=1) * decay_factor
    total = 2 * np.sum(np.abs(found.model + found.residual) ** 2) / spectrum.samples**2
    return energies / total


def _identified_modes(found: PoleFit, scatter, spectrum: Spectrum) -> tuple[IdentifiedMode, ...]:
    """Frequency |p| / 2 pi and damping ratio s / |p| of each pole, with standard deviations."""
    modes = []
    for k, (pole, share) in enumerate(
        zip(found.poles, _energy_shares(found, spectrum), strict=True)
    ):
        covariance = found.covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        covariance = covariance + np.diag(scatter[2 * k : 2 * k + 2])
        rate, angular_frequency, size = -pole.real, pole.imag, abs(pole)
        by_frequency = np.array([rate, angular_frequency]) / size / (2 * np.pi)
        by_damping = np.array([angular_frequency**2, -rate * angular_frequency]) / size**3
        modes.append(
            IdentifiedMode(
                frequency=float(size / (2 * np.pi)),
                frequency_sd=float(np.sqrt(by_frequency @ covariance @ by_frequency)),
                damping_ratio=float(rate / size),
                damping_sd=float(np.sqrt(by_damping @ covariance @ by_damping)),
                energy_share=float(share),
            )
        )
    return tuple(modes)
