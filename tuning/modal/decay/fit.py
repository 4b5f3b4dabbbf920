"""Modes from free decays: poles, shapes, and rejection of poles that are not reproduced."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.signal import detrend
from scipy.stats import t as student

from tuning.modal.decay.poles import (
    FEWER_LEAKAGE_ORDER,
    PoleFit,
    Spectrum,
    band_spectrum,
    find_poles,
    pole_parameters,
    refine,
)
from tuning.modal.result import IdentifiedMode, frequency_and_damping

MIN_BINS = 8  # bins of a spectrum to find poles in
MAX_POLE_SHIFT_SD = 4.0  # standard deviations by which a pole may differ in a shorter window
SHORTER_WINDOW_CUT = 0.2  # share of the window that is cut off for a shorter one
MIN_ENERGY_LEFT = 0.1  # share of the energy of a mode in a shorter window that tells about it
WEAK_ENERGY_SHARE = 0.2  # of the strongest mode's energy; below it poles must be reproduced


class DecayFit(NamedTuple):
    """Modes of free decays, and the fit in the band.

    `energies` are sums of squared samples of each mode in each column; `gone` tells which modes are
    not reproduced in shorter windows; `measured` and `fitted` have a column for each channel of
    each decay, `fitted` with drift and leakage into the band.
    """

    modes: tuple[IdentifiedMode, ...]
    energies: Float[np.ndarray, "mode column"]
    gone: tuple[bool, ...]
    measured: Float[np.ndarray, "sample column"]
    fitted: Float[np.ndarray, "sample column"]


def fit_decay(
    values: Float[np.ndarray, "sample column"],
    rate: float,
    band: tuple[float, float],
    channels: int,
    poles: Complex[np.ndarray, " start"] | None = None,
) -> DecayFit | None:
    """Modes from free decays of one length, side by side (column: the channels of each decay).

    `poles` (1/s) are those to start from, of a subspace method. A weak mode must be reproduced in
    the window without its first and without its last fifth. The change of a pole there, beyond what
    noise explains, adds to its uncertainty (frequency and damping of a real structure depend
    slightly on amplitude), and so does the change with fewer terms for modes outside the band.
    None if the band has too few bins.
    """
    count = len(values)
    values = detrend(values, axis=0)  # lines are among the drifts that the fit allows
    spectrum = band_spectrum(values, rate, band)
    if spectrum.bins.size < MIN_BINS:
        return None
    found = find_poles(spectrum, start=poles)
    cut = int(SHORTER_WINDOW_CUT * count)
    # Of a mode that decays within its first fifth, the rest of a window says nothing.
    lasting = np.exp(2 * found.poles.real * cut / rate) > MIN_ENERGY_LEFT
    shorter = [
        (_refit(found, spectrum, band_spectrum(values[first:last], rate, band)), told)
        for first, last, told in ((cut, count, lasting), (0, count - cut, lasting | True))
    ]
    fewer = refine(found.poles, spectrum, found.noise, leakage_order=FEWER_LEAKAGE_ORDER)
    outside = (pole_parameters(fewer.poles) - pole_parameters(found.poles)) ** 2
    variance = _nonstationary_variance(found, shorter) + outside
    modes = _identified_modes(found, variance, spectrum, channels)
    gone = _not_reproduced(found, shorter, spectrum)
    return DecayFit(
        modes=modes,
        energies=_energies(found, spectrum),
        gone=tuple(gone.tolist()),
        measured=inverse_transform(spectrum.values, spectrum),
        fitted=inverse_transform(spectrum.values - found.residual, spectrum),
    )


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
    for other, told in others:
        deviation = np.sqrt(np.diag(found.covariance) + np.diag(other.covariance))
        change = np.abs(pole_parameters(other.poles) - pole_parameters(found.poles)) / deviation
        change = np.where(other.poles.real > 0, np.inf, np.max(change.reshape(-1, 2), axis=1))
        moved = np.maximum(moved, np.where(told, change, 0.0))
    share = np.sum(_energies(found, spectrum), axis=1)
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
    compared = np.sum([told for _, told in others], axis=0)
    for other, told in others:
        expected = np.maximum(np.diag(other.covariance) - np.diag(found.covariance), 0)
        change = (pole_parameters(other.poles) - pole_parameters(found.poles)) ** 2
        beyond = np.where(change > 4 * expected, change - expected, 0)
        extra += np.repeat(told / np.maximum(compared, 1), 2) * beyond / 3
    return extra


def _energies(found: PoleFit, spectrum: Spectrum) -> Float[np.ndarray, "mode column"]:
    """Sums of squared samples of each mode in each column."""
    rates = 2 * -found.poles.real * spectrum.duration
    decay_factor = np.where(
        np.abs(rates) < 1e-6, 1.0, -np.expm1(-rates) / np.where(rates, rates, 1)
    )
    return 0.5 * spectrum.samples * np.abs(found.amplitudes) ** 2 * decay_factor[:, None]


def _identified_modes(
    found: PoleFit, scatter, spectrum: Spectrum, channels: int
) -> tuple[IdentifiedMode, ...]:
    """Frequency |p| / 2 pi and damping ratio s / |p| of each pole, with standard deviations."""
    modes = []
    quantiles = student.ppf(0.975, np.maximum(found.degrees_of_freedom, 3.0)).tolist()
    for k, pole in enumerate(found.poles):
        covariance = found.covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        covariance = covariance + np.diag(scatter[2 * k : 2 * k + 2])
        frequency, frequency_sd, damping_ratio, damping_sd = frequency_and_damping(pole, covariance)
        shape, shape_covariance = _shape(found, k, channels)
        modes.append(
            IdentifiedMode(
                frequency=frequency,
                frequency_sd=frequency_sd,
                damping_ratio=damping_ratio,
                damping_sd=damping_sd,
                energy_share=math.nan,  # told by `energies`
                shape=shape,
                shape_covariance=shape_covariance,
                quantile=quantiles[k],
            )
        )
    return tuple(modes)


def _shape(found: PoleFit, mode: int, channels: int):
    """Shape common to all decays (largest component one), and the covariance of its parts.

    The amplitudes (decay, channel) are of rank one: shape times participation. Their variance is
    that of the noise at the mode's frequency, divided by the energy of its decaying sinusoid.
    """
    amplitudes = found.amplitudes[mode].reshape(-1, channels)
    _, sizes, rows = np.linalg.svd(amplitudes, full_matrices=False)
    shape = rows[0]
    largest = int(np.argmax(np.abs(shape)))
    unit = shape / shape[largest]
    noise = found.amplitude_variance[mode].reshape(-1, channels).mean(axis=0)
    # Along the largest component's participation, each component's variance is noise / size^2.
    participation = (sizes[0] * np.abs(shape[largest])) ** 2
    variance = (noise + np.abs(unit) ** 2 * noise[largest]) / max(participation, 1e-300)
    variance[largest] = 0.0
    return unit, np.diag(np.concatenate([variance, variance]) / 2)
