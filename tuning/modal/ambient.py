"""Modes from the response to ambient excitation, by maximum likelihood on the spectrum.

Under excitation whose spectrum is flat across a resonance, the power spectrum of channel c is

    M_c(f) = b_c + d_c (f_0 / f)^2 + sum_k a_kc r^q / ((1 - r^2)^2 + (2 z_k r)^2),   r = f / f_k,

with q = 0, 2, 4 for deflection, velocity, acceleration; b is the noise and d the drift. The power
in the bins of a long record is independent and exponentially distributed about it, which gives the
likelihood (Whittle 1953). Channels are added as if independent; the covariance is that of fully
coherent channels, as they are near a resonance.
"""

import numpy as np
from scipy.optimize import minimize
from scipy.stats import norm

from tuning.logs.units import time_derivative
from tuning.modal.decay_fit import MIN_BINS, inverse_transform
from tuning.modal.decay_poles import (
    FALSE_ALARM_PROBABILITY,
    MAX_MODES,
    Spectrum,
    band_spectrum,
)
from tuning.modal.result import IdentifiedMode, ModeCandidates, rejection_reason

MIN_DAMPING_RATIO, INITIAL_DAMPING_RATIOS = 1e-5, (0.003, 0.01, 0.03)
SMOOTHING_WIDTHS_BINS = (0, 1, 4, 12)  # half widths of the moving averages that show resonances


def fit_ambient(values, rate: float, start: int, stop: int, band, quantities) -> ModeCandidates:
    """Modes from the samples `start` to `stop` of a log (values: time, channel)."""
    spectrum = band_spectrum(values[start:stop], rate, band)
    modes, reasons = (), ()
    if spectrum.bins.size >= MIN_BINS:
        exponents = np.array([2 * time_derivative(name) for name in quantities])
        modes = _find_modes(spectrum, exponents)
        reasons = tuple(rejection_reason(mode, spectrum.duration, band) for mode in modes)
    return ModeCandidates(
        modes=modes,
        rejection_reasons=reasons,
        start=start,
        stop=stop,
        quantile=float(norm.ppf(0.975)),
        measured=inverse_transform(spectrum.values, spectrum),
        fitted=None,
    )


def _find_modes(spectrum: Spectrum, exponents) -> tuple[IdentifiedMode, ...]:
    """Resonances, added one at a time as long as the likelihood gains more than by chance."""
    power = np.abs(spectrum.values) ** 2
    reference_power = np.median(power, axis=0) + 1e-30 * power.max()
    power, bins, channels = power / reference_power, spectrum.bins, power.shape[1]
    min_gain = channels + 2 + np.log(len(bins) / FALSE_ALARM_PROBABILITY)
    data = (bins, power, exponents)
    start = _maximise_likelihood(np.repeat([0.0, -2.0], channels), data)
    best, parameters = start.fun, start.x
    while parameters.size < (channels + 2) * MAX_MODES:
        ratio = power / _model(parameters, bins, exponents)[0].T
        starts = [np.append(parameters, guess) for guess in _initial_guesses(ratio, bins)]
        trial = _maximise_likelihood(
            min(starts, key=lambda start: _negative_log_likelihood(start, *data)[0]), data
        )
        if best - trial.fun < min_gain:
            break
        best, parameters = trial.fun, trial.x
    return _identified_modes(parameters, data, reference_power)


def _initial_guesses(ratio, bins):
    """Parameters (log f, log z, log a_c) of resonances where power exceeds the model most."""
    guesses = set()
    for width in SMOOTHING_WIDTHS_BINS:
        window = np.ones(2 * width + 1) / np.sqrt(2 * width + 1)
        guesses.add(int(np.argmax(np.convolve(ratio.sum(axis=1) - ratio.shape[1], window, "same"))))
    for peak in sorted(guesses):
        height = np.maximum(ratio[max(peak - 1, 0) : peak + 2].mean(axis=0), 0.1)
        for damping in INITIAL_DAMPING_RATIOS:
            level = np.log(height * (2 * damping) ** 2)
            yield np.concatenate([[np.log(bins[peak]), np.log(damping)], level])


def _model(parameters, bins, exponents):
    """Power of each channel and bin, and its derivatives (parameter, channel, bin).

    Parameters are logarithms: b and d of all channels, then of each mode f_k, z_k and a_kc.
    """
    channels = exponents.size
    gradient = np.zeros((parameters.size, channels, bins.size))
    levels = np.exp(parameters[: 2 * channels])
    drift = (bins[0] / bins) ** 2
    for c in range(channels):
        gradient[c, c] = levels[c]
        gradient[channels + c, c] = levels[channels + c] * drift
    model = gradient[: 2 * channels].sum(axis=0)
    for offset in range(2 * channels, parameters.size, channels + 2):
        square = (bins / np.exp(parameters[offset])) ** 2
        damping = np.exp(parameters[offset + 1])
        denominator = (1 - square) ** 2 + 4 * damping**2 * square
        shapes = {q: square ** (q // 2) / denominator for q in set(exponents.tolist())}
        by_square = (-2 * (1 - square) + 4 * damping**2) * square / denominator
        by_damping = -8 * damping**2 * square / denominator
        for c, q in enumerate(exponents.tolist()):
            part = np.exp(parameters[offset + 2 + c]) * shapes[q]
            gradient[offset, c] = part * (2 * by_square - q)
            gradient[offset + 1, c] = part * by_damping
            gradient[offset + 2 + c, c] = part
            model[c] += part
    return model, gradient


def _negative_log_likelihood(parameters, bins, power, exponents):
    """Negative logarithm of the likelihood, and its gradient."""
    model, gradient = _model(parameters, bins, exponents)
    ratio = power.T / model
    cost = np.sum(np.log(model) + ratio)
    return cost, gradient.reshape(parameters.size, -1) @ ((1 - ratio) / model).ravel()


def _maximise_likelihood(parameters, data):
    """Solution of scipy from a start, with frequencies in the band and bounded damping."""
    bins, _, exponents = data
    mode_bounds = [(np.log(bins[0]), np.log(bins[-1])), (np.log(MIN_DAMPING_RATIO), 0.0)]
    mode_bounds += [(-60.0, 60.0)] * exponents.size
    count = (parameters.size - 2 * exponents.size) // len(mode_bounds)
    bounds = [(-30.0, 60.0)] * (2 * exponents.size) + mode_bounds * count
    return minimize(_negative_log_likelihood, parameters, data, "L-BFGS-B", jac=True, bounds=bounds)


def _identified_modes(parameters, data, reference_power) -> tuple[IdentifiedMode, ...]:
    """Modes with standard deviations (sandwich covariance, coherent channels) and energies."""
    bins, power, exponents = data
    channels = exponents.size
    model, gradient = _model(parameters, bins, exponents)
    relative = gradient / model
    channel_rows, summed_rows = relative.reshape(parameters.size, -1), relative.sum(axis=1)
    inverse = np.linalg.pinv(channel_rows @ channel_rows.T, hermitian=True)
    covariance = inverse @ (summed_rows @ summed_rows.T) @ inverse
    deviation = np.sqrt(np.diag(covariance))
    found = []
    for offset in range(2 * channels, parameters.size, channels + 2):
        frequency, damping = np.exp(parameters[offset : offset + 2])
        part = gradient[offset + 2 + np.arange(channels), np.arange(channels)].T
        found.append(
            IdentifiedMode(
                frequency=float(frequency),
                frequency_sd=float(frequency * deviation[offset]),
                damping_ratio=float(damping),
                damping_sd=float(damping * deviation[offset + 1]),
                energy_share=float(
                    np.sum(part * reference_power) / np.sum(power * reference_power)
                ),
            )
        )
    return tuple(sorted(found))
