"""Modes from the response to ambient excitation, by maximum likelihood on the spectrum.

Under excitation whose spectrum is flat across a resonance, the power spectrum of channel c is

    M_c(f) = b_c + d_c (f_0 / f)^2 + sum_k a_kc r^q / ((1 - r^2)^2 + (2 z_k r)^2),   r = f / f_k,

with q = 0, 2, 4 for deflection, velocity, acceleration; b is the noise and d the drift. The power
in the bins of a long record is independent and exponentially distributed about it, which
gives the likelihood (Whittle 1953). Channels are added as if independent; as they are not, the
covariance is that of fully coherent channels, which near a resonance they are.
"""

import numpy as np
from scipy.optimize import minimize
from scipy.stats import norm

from tuning.modal.decay_fit import LEAST_BINS, in_time
from tuning.modal.decay_poles import MOST_MODES, Spectrum, transform
from tuning.modal.result import Findings, Mode, reason_against

_SLOPE = {"deflection": 0, "velocity": 2, "acceleration": 4}
CHANCE = 1e-4
LEAST_DAMPING, START_DAMPING = 1e-5, (0.003, 0.01, 0.03)
# A resonance must stand on enough bins for its width to be seen.
WIDTHS = (0, 1, 4, 12)


def fit_ambient(values, rate: float, start: int, stop: int, band, quantities) -> Findings:
    """Identify modes from the samples `start` to `stop` of a log (values: time, channel)."""
    spectrum = transform(values[start:stop], rate, band)
    modes, reasons = (), ()
    if spectrum.bins.size >= LEAST_BINS:
        modes = _find_modes(spectrum, np.array([_SLOPE.get(name, 0) for name in quantities]))
        reasons = tuple(reason_against(mode, spectrum.duration, band) for mode in modes)
    return Findings(
        modes=modes,
        reasons=reasons,
        start=start,
        stop=stop,
        quantile=float(norm.ppf(0.975)),
        measured=in_time(spectrum.values, spectrum),
        fitted=None,
    )


def _find_modes(spectrum: Spectrum, slopes) -> tuple[Mode, ...]:
    """Add resonances one at a time while the likelihood gains more than chance would give."""
    power = np.abs(spectrum.values) ** 2
    unit = np.median(power, axis=0) + 1e-30 * power.max()
    power, bins, channels = power / unit, spectrum.bins, power.shape[1]
    worth = channels + 2 + np.log(len(bins) / CHANCE)
    shape = (bins, power, slopes)
    start = _refined(np.repeat([0.0, -2.0], channels), shape)
    best, parameters = start.fun, start.x
    while parameters.size < (channels + 2) * MOST_MODES:
        ratio = power / _model(parameters, bins, slopes)[0].T
        starts = [np.append(parameters, guess) for guess in _guesses(ratio, bins)]
        trial = _refined(min(starts, key=lambda start: _cost(start, *shape)[0]), shape)
        if best - trial.fun < worth:
            break
        best, parameters = trial.fun, trial.x
    return _modes(parameters, shape, unit)


def _guesses(ratio, bins):
    """Parameters (log f, log z, log a_c) of resonances where the power exceeds the model most."""
    guesses = set()
    for width in WIDTHS:
        window = np.ones(2 * width + 1) / np.sqrt(2 * width + 1)
        guesses.add(int(np.argmax(np.convolve(ratio.sum(axis=1) - ratio.shape[1], window, "same"))))
    for peak in sorted(guesses):
        height = np.maximum(ratio[max(peak - 1, 0) : peak + 2].mean(axis=0), 0.1)
        for damping in START_DAMPING:
            level = np.log(height * (2 * damping) ** 2)
            yield np.concatenate([[np.log(bins[peak]), np.log(damping)], level])


def _model(parameters, bins, slopes):
    """Power of each channel and bin, and its slopes by parameters (parameter, channel, bin).

    Parameters are logarithms: b and d of all channels, then of each mode f_k, z_k and a_kc.
    """
    channels = slopes.size
    gradient = np.zeros((parameters.size, channels, bins.size))
    levels = np.exp(parameters[: 2 * channels])
    drift = (bins[0] / bins) ** 2
    for c in range(channels):
        gradient[c, c] = levels[c]
        gradient[channels + c, c] = levels[channels + c] * drift
    model = gradient[: 2 * channels].sum(axis=0)
    for place in range(2 * channels, parameters.size, channels + 2):
        square = (bins / np.exp(parameters[place])) ** 2
        damping = np.exp(parameters[place + 1])
        bottom = (1 - square) ** 2 + 4 * damping**2 * square
        shapes = {slope: square ** (slope // 2) / bottom for slope in set(slopes.tolist())}
        by_square = (-2 * (1 - square) + 4 * damping**2) * square / bottom
        by_damping = -8 * damping**2 * square / bottom
        for c, slope in enumerate(slopes.tolist()):
            part = np.exp(parameters[place + 2 + c]) * shapes[slope]
            gradient[place, c] = part * (2 * by_square - slope)
            gradient[place + 1, c] = part * by_damping
            gradient[place + 2 + c, c] = part
            model[c] += part
    return model, gradient


def _cost(parameters, bins, power, slopes):
    """Minus the logarithm of the likelihood, and its gradient."""
    model, gradient = _model(parameters, bins, slopes)
    ratio = power.T / model
    cost = np.sum(np.log(model) + ratio)
    return cost, gradient.reshape(parameters.size, -1) @ ((1 - ratio) / model).ravel()


def _refined(parameters, shape):
    """Best parameters from a start, frequencies in the band and damping in a wide range."""
    bins, _, slopes = shape
    each = [(np.log(bins[0]), np.log(bins[-1])), (np.log(LEAST_DAMPING), 0.0)]
    each += [(-60.0, 60.0)] * slopes.size
    count = (parameters.size - 2 * slopes.size) // len(each)
    bounds = [(-30.0, 60.0)] * (2 * slopes.size) + each * count
    return minimize(_cost, parameters, shape, "L-BFGS-B", jac=True, bounds=bounds)


def _modes(parameters, shape, unit) -> tuple[Mode, ...]:
    """Modes with standard deviations (sandwich covariance, coherent channels) and energies."""
    bins, power, slopes = shape
    channels = slopes.size
    model, gradient = _model(parameters, bins, slopes)
    relative = gradient / model
    apart, together = relative.reshape(parameters.size, -1), relative.sum(axis=1)
    inverse = np.linalg.pinv(apart @ apart.T, hermitian=True)
    covariance = inverse @ (together @ together.T) @ inverse
    deviation = np.sqrt(np.diag(covariance))
    found = []
    for place in range(2 * channels, parameters.size, channels + 2):
        frequency, damping = np.exp(parameters[place : place + 2])
        part = gradient[place + 2 + np.arange(channels), np.arange(channels)].T
        found.append(
            Mode(
                frequency=float(frequency),
                frequency_sd=float(frequency * deviation[place]),
                damping_ratio=float(damping),
                damping_sd=float(damping * deviation[place + 1]),
                share=float(np.sum(part * unit) / np.sum(power * unit)),
            )
        )
    return tuple(sorted(found))
