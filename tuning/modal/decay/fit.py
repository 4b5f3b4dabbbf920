"""Modes from free decays: poles, shapes, and rejection of poles that are not reproduced.

Then they are candidates, with the reasons for rejecting them, and their energies.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.signal import detrend
from scipy.stats import t as student

from tuning.modal.ambient import Candidate, without_duplicates
from tuning.modal.decay.excitation import PARTS
from tuning.modal.decay.poles import (
    FEWER_LEAKAGE_ORDER,
    PoleFit,
    Spectrum,
    band_spectrum,
    find_poles,
    pole_parameters,
    refine,
)
from tuning.modal.result import (
    MAX_DAMPING_RATIO,
    MIN_COLLINEARITY,
    IdentifiedMode,
    frequency_and_damping,
    mac_matrix,
    rejection_reason,
)

MIN_BINS = 8  # bins of a spectrum to find poles in
MAX_POLE_SHIFT_SD = 4.0  # standard deviations by which a pole may differ in a shorter window
SHORTER_WINDOW_CUT = 0.2  # fraction of the window that is cut off for a shorter one
MIN_ENERGY_LEFT = 0.1  # fraction of a mode's energy that a shorter window must hold to count
WEAK_ENERGY = 0.2  # of the strongest mode's energy; below it poles must be reproduced


class DecayFit(NamedTuple):
    """Modes of free decays, and the fit in the band.

    `energies` are sums of squared samples of each mode in each column; `gone` marks modes that are
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
        (_refit(found, spectrum, band_spectrum(values[first:last], rate, band)), counts)
        for first, last, counts in ((cut, count, lasting), (0, count - cut, lasting | True))
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
    """Mask of weak poles that differ in shorter windows (mode,).

    A weak pole near a strong one often stands for the nonlinearity of the strong one: it stays in
    the fit, but is no mode.
    """
    moved = np.zeros(found.poles.size)
    for other, counts in others:
        deviation = np.sqrt(np.diag(found.covariance) + np.diag(other.covariance))
        change = np.abs(pole_parameters(other.poles) - pole_parameters(found.poles)) / deviation
        change = np.where(other.poles.real > 0, np.inf, np.max(change.reshape(-1, 2), axis=1))
        moved = np.maximum(moved, np.where(counts, change, 0.0))
    energy = np.sum(_energies(found, spectrum), axis=1)
    return (moved > MAX_POLE_SHIFT_SD) & (energy < WEAK_ENERGY * np.max(energy, initial=0.0))


def _refit(found: PoleFit, spectrum: Spectrum, other: Spectrum) -> PoleFit:
    """The poles refined on another window, with the noise level of the first."""
    levels = [np.interp(other.bins, spectrum.bins, level) for level in found.noise.T]
    return refine(found.poles, other, np.stack(levels, 1) * other.samples / spectrum.samples)


def _nonstationary_variance(found: PoleFit, others):
    """Variance of (s, w) of each pole over the window, beyond what noise explains.

    For a uniform distribution over the range seen: a third of the square of half the range.
    """
    extra = np.zeros(2 * found.poles.size)
    compared = np.sum([counts for _, counts in others], axis=0)
    for other, counts in others:
        expected = np.maximum(np.diag(other.covariance) - np.diag(found.covariance), 0)
        change = (pole_parameters(other.poles) - pole_parameters(found.poles)) ** 2
        beyond = np.where(change > 4 * expected, change - expected, 0)
        extra += np.repeat(counts / np.maximum(compared, 1), 2) * beyond / 3
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
                energy_share=math.nan,  # computed from `energies` by the caller
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


NOT_REPRODUCED = "not the same in parts of the window"
NONLINEARITY = "what nonlinearity adds to the mode of"
NONLINEAR_DECAY = 2.5, 4.5  # decay rate of a mode's nonlinear part over that of the mode
SKIRT_BANDWIDTHS = 4.0  # half widths of a peak, to where its amplitude has fallen to a quarter
NONLINEAR_MAC = 0.95  # least MAC of a mode and its nonlinear part
# Energy of a mode's nonlinear part over that of the mode. The phase of the mode moves by k in all,
# so that the first nonlinear term has k^2 / 3 of its energy; fits of Duffing's equation with more
# than two terms give up to four.
MAX_CUBE_ENERGY = 4.0
MAX_CUBE_SPREAD = 3.0  # of energies of several decays over what they would be of cubes

BandFits = list[tuple[tuple[float, float], DecayFit]]  # of parts of a band (Hz)


def decay_candidates(
    fits: BandFits,
    decays: int,
    derivatives: tuple[int, ...],
    duration: float,
    band: tuple[float, float],
    is_free: bool = False,
) -> tuple[Candidate, ...]:
    """Candidate modes of all parts of the band, with their fractions of its energy.

    In decays that are free for sure (`is_free`) a shape may be complex, and frequency and damping
    depend on amplitude, which widens their intervals: no force makes it so.
    Columns of the fits are the channels of each of several `decays`, or of combinations of these;
    `derivatives` are the orders of the channels as time derivatives. A mode is too weak only if it
    has little of the energy of the readings and of that of velocities: the lower of two modes of
    one velocity has less acceleration.
    """
    found, by_decay, channels = [], [], len(derivatives)
    collinear = 0.0 if is_free else MIN_COLLINEARITY
    for part, fit in fits:
        parts = fit.energies.shape[1] // channels
        columns = fit.energies.reshape(-1, parts, channels)
        shares = _shares(columns, fit, duration, (1,) * channels)
        kinetic = _shares(columns, fit, duration, derivatives)
        energies = columns.sum(axis=2)
        if parts != decays:  # combinations of decays
            energies = energies.sum(axis=1, keepdims=True)
        changing = fit.gone
        if is_free:
            changing = tuple(
                gone and _is_near_stronger(k, fit.modes, shares) for k, gone in enumerate(fit.gone)
            )
        for mode, share, moved, gone, energy in zip(
            fit.modes, shares.tolist(), kinetic.tolist(), changing, energies, strict=True
        ):
            if part[0] <= mode.frequency < part[1] or len(fits) == 1:
                mode = mode._replace(energy_share=share)
                larger = mode._replace(energy_share=max(share, moved))
                reason = rejection_reason(larger, duration, band, collinear) or (
                    NOT_REPRODUCED if gone else ""
                )
                found.append(Candidate(mode, reason, 1))
                by_decay.append(energy)
    return without_duplicates(_without_nonlinearity(found, by_decay))


def _shares(
    energies: Float[np.ndarray, "mode part channel"],
    fit: DecayFit,
    duration: float,
    derivatives: tuple[int, ...],
) -> Float[np.ndarray, " mode"]:
    """Fractions of the modes in the energy of velocities, averaged over channels.

    Channels are time derivatives of orders `derivatives`; as velocities themselves they keep the
    energy of their readings.
    """
    power = 2.0 * (1 - np.array(derivatives))
    spectrum = np.abs(np.fft.rfft(fit.measured, axis=0)[1:]) ** 2
    spectrum = spectrum.reshape(len(spectrum), -1, len(derivatives)).sum(axis=1)
    bins = np.arange(1, 1 + len(spectrum))[:, None] / duration
    total = 2 / len(fit.measured) * np.sum(spectrum * bins**power, axis=0)
    own = np.array([one.frequency for one in fit.modes])[:, None] ** power
    return np.mean(own * energies.sum(axis=1) / np.maximum(total, 1e-300), axis=1)


def _is_near_stronger(k, modes, shares) -> bool:
    """Whether a mode lies in the peak of a stronger one, whose nonlinearity it may stand for."""
    return any(
        shares[j] > shares[k]
        and abs(one.frequency - modes[k].frequency)
        < SKIRT_BANDWIDTHS * max(one.damping_ratio, 0.0) * one.frequency
        for j, one in enumerate(modes)
    )


def share_of_modes(found: tuple[Candidate, ...], fits: BandFits, duration: float) -> float:
    """Fraction of the energy at the beginning of decays in identified modes, not in rejected ones.

    What nonlinearity adds to a mode is a part of it.

    That is the first tenth: the energy over all of a decay would count steady hum for more, that at
    the first sample a pole that is gone at the next. Poles damped too strongly for modes, which
    stand for leakage into the band or the end of an impact, do not count.
    """
    good = rejected = 0.0
    for part, fit in fits:
        inside = [one for one in found if len(fits) == 1 or part[0] <= one.mode.frequency < part[1]]
        for one in inside:
            if one.mode.damping_ratio > MAX_DAMPING_RATIO:
                continue
            nepers = 4 * np.pi * one.mode.frequency * one.mode.damping_ratio * duration
            early = np.expm1(-nepers / PARTS) / np.expm1(-nepers) if nepers > 1e-6 else 1 / PARTS
            energy = early * np.sum(fit.measured**2)
            if one.reason and not one.reason.startswith(NONLINEARITY):
                # Poles side by side may cancel each other, each with many times the energy of all.
                rejected += min(one.mode.energy_share, 1.0) * energy
            else:
                good += one.mode.energy_share * energy
    return float(good / max(good + rejected, 1e-300))


def _without_nonlinearity(found: list[Candidate], by_decay) -> list[Candidate]:
    """Candidates, with those rejected that are the cube of another mode by a nonlinear spring.

    The cube of a decaying vibration has its frequency and shape, three times its decay rate, and
    less energy, as what it adds is a correction; of several decays, it grows as the cube of theirs.
    """
    good = [(one.mode, own) for one, own in zip(found, by_decay, strict=True) if not one.reason]
    return [
        one if one.reason else one._replace(reason=next(
            (f"{NONLINEARITY} {other.frequency:.4g} Hz"
             for other, theirs in good
             if _is_cube(one.mode, other) and _grows_as_cube(own, theirs)), ""))
        for one, own in zip(found, by_decay, strict=True)
    ]  # fmt: skip


def _is_cube(mode: IdentifiedMode, other: IdentifiedMode) -> bool:
    """Whether a mode decays like the cube of another mode, within its half-power bandwidth."""
    rate = mode.pole.real / other.pole.real
    near = abs(mode.frequency - other.frequency) < mode.damping_ratio * mode.frequency
    alike = mac_matrix(mode.shape[None], other.shape[None])[0, 0] > NONLINEAR_MAC
    less = mode.energy_share < MAX_CUBE_ENERGY * other.energy_share
    return bool(near and alike and less and NONLINEAR_DECAY[0] < rate < NONLINEAR_DECAY[1])


def _grows_as_cube(energies, others) -> bool:
    """Whether energies of a mode in several decays are in proportion to the cubes of another's."""
    ratios = energies / np.maximum(others, 1e-300) ** 3
    return bool(ratios.max() < MAX_CUBE_SPREAD * ratios.min())


def information_of_modes(found: tuple[Candidate, ...]) -> float:
    """Logarithm of the determinant of the information on damping ratios of modes (D-optimality).

    A mode counts by the ratio of its damping to its 95 % interval; a rejected one does not count.
    """
    modes = [one.mode for one in found if not one.reason]
    return float(
        sum(2 * np.log(one.damping_ratio / (one.quantile * one.damping_sd)) for one in modes)
    )
