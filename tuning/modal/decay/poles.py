"""Poles of a free decay, by maximum likelihood in the frequency domain.

The samples of a decay are damped sinusoids common to all channels, a slow drift, and noise:

    y_c(t) = sum_k Re(a_kc exp(p_k t)) + drift_c(t) + noise_c(t),   p_k = -s_k + i w_k.

The discrete Fourier transform over the N samples of the window is known in closed form, with the
truncation at its end: a geometric series, S(p, w) = (exp(p N h) - 1) / (exp((p - i w) h) - 1).
Coloured noise, too, is nearly independent from bin to bin, so that least squares weighted by its
local level is maximum likelihood. The amplitudes are linear and are projected out (variable
projection: Golub and Pereyra 1973, Kaufman 1975). Modes are added one at a time where the residual
is largest, all refined together each time (RELAX: Li and Stoica 1996), as long as the likelihood
gains more than by chance.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.optimize import least_squares
from scipy.stats import chi2

NOISE_SMOOTHING_BINS = 12  # bins on either side over which the noise level is averaged
MAX_MODES = 24  # of a decay, in three octaves
CLEAR_GAIN = 20.0  # least gains in likelihood of a mode that is not tried to be left out
MAX_ADDED_MODES = 6  # to those that a subspace method has found
FALSE_ALARM_PROBABILITY = 1e-4  # of a mode found in noise, over all bins
# No structure is exactly linear: the misfit of a strong mode looks like weak ones near it. Peaks
# below this fraction of the amplitudes nearby are not taken for modes.
NONLINEAR_AMPLITUDE = 0.03
NEARBY_BINS = 2  # bins on either side that count as nearby
COARSE_TOLERANCE = 1e-3  # of the refinement while modes are counted
MAX_POLE_SHIFT_BINS = 1.5  # bins by which a pole may move in one refinement
DRIFT_ORDER = 3  # of the polynomial for the drift over the window
LEAKAGE_ORDER = 2  # of the polynomial for leakage from modes outside the band
FEWER_LEAKAGE_ORDER = 0  # with which poles are compared


class Spectrum(NamedTuple):
    """Fourier transform of a window: bins (Hz), values, number of samples and their step (s)."""

    bins: Float[np.ndarray, " bin"]
    values: Complex[np.ndarray, "bin channel"]
    samples: int
    step: float

    @property
    def duration(self) -> float:
        """Length of the window (s); bins are 1 / duration apart."""
        return self.samples * self.step


class PoleFit(NamedTuple):
    """Poles fitted to a spectrum, and the residual.

    `poles` (1/s) are in the upper half plane; `covariance` is that of (s_1, w_1, s_2,
    w_2, ...), minus their real parts and their imaginary parts; `amplitudes` are those at the start
    of the window and `amplitude_variance` their variances; `model` is the part of the spectrum due
    to modes; `degrees_of_freedom` are those of the noise level about each pole, for intervals.
    """

    poles: Complex[np.ndarray, " mode"]
    covariance: Float[np.ndarray, "parameter parameter"]
    amplitudes: Complex[np.ndarray, "mode channel"]
    amplitude_variance: Float[np.ndarray, "mode channel"]
    model: Complex[np.ndarray, "bin channel"]
    residual: Complex[np.ndarray, "bin channel"]
    noise: Float[np.ndarray, "bin channel"]
    degrees_of_freedom: Float[np.ndarray, " mode"]


def band_spectrum(
    values: Float[np.ndarray, "time channel"], rate: float, band: tuple[float, float]
) -> Spectrum:
    """Spectrum of samples taken at `rate` (Hz), with the bins of a band (Hz) above zero."""
    count = len(values)
    bins = np.fft.rfftfreq(count, 1 / rate)
    # The bin of the Nyquist frequency is left out: it is real, unlike all others.
    keep = (bins >= band[0]) & (bins <= band[1]) & (bins > 0) & (bins < rate / 2)
    return Spectrum(bins[keep], np.fft.rfft(values, axis=0)[keep], count, 1 / rate)


def find_poles(
    spectrum: Spectrum,
    start: Complex[np.ndarray, " start"] | None = None,
) -> PoleFit:
    """Poles, MAX_MODES at most, of the modes that are significant in a free decay's spectrum.

    `start` are poles (1/s) to begin with; those in the band are refined, and kept if significant.
    """
    channels = spectrum.values.shape[1]
    # Half the drop in weighted squares is what the likelihood gains: by chance half a chi-square
    # variable of two degrees of freedom for each channel, and two for the pole.
    trials = 4 * spectrum.bins.size
    min_gain = float(chi2.isf(FALSE_ALARM_PROBABILITY / trials, 2 * (channels + 1)) / 2)
    best = refine(np.zeros(0, complex), spectrum, _robust_level(spectrum.values))
    misfit_level = _misfit_level(spectrum)
    nuisance = _nuisance_columns(spectrum).shape[1]
    most = max(2 * spectrum.bins.size - nuisance, 0) // 3  # a third of the numbers are left over
    max_modes = MAX_MODES
    if start is not None and start.size:
        frequencies = start.imag / (2 * np.pi)
        inside = (frequencies > spectrum.bins[0]) & (frequencies < spectrum.bins[-1])
        level = _robust_level(spectrum.values) + misfit_level
        best = refine(start[inside][:most], spectrum, level, COARSE_TOLERANCE)
        max_modes = min(max_modes, best.poles.size + MAX_ADDED_MODES)
    while best.poles.size < min(max_modes, most):
        level = _robust_level(best.residual) + misfit_level
        trial = with_one_more(best, spectrum)
        if (
            _weighted_squares(best.residual, level) - _weighted_squares(trial.residual, level)
            < min_gain
        ):
            break
        best = trial
    best = _prune_poles(best, spectrum, misfit_level, min_gain)
    for _ in range(2):
        best = refine(best.poles[np.argsort(best.poles.imag)], spectrum, best.noise)
    return best


def _misfit_level(spectrum: Spectrum):
    """Squared amplitudes at each bin that nonlinearity of strong modes nearby may cause."""
    nearby = _smooth(np.abs(spectrum.values) ** 2, NEARBY_BINS) / (2 * NEARBY_BINS + 1)
    return NONLINEAR_AMPLITUDE**2 * nearby


def _prune_poles(best: PoleFit, spectrum: Spectrum, misfit_level, min_gain: float) -> PoleFit:
    """The fit without poles that are not significant given the others, removed weakest first."""
    level = _robust_level(best.residual) + misfit_level
    best = refine(best.poles, spectrum, level)
    # What a mode well apart from others explains; a fit without it is tried only if that is little.
    gains = np.sum(np.abs(best.amplitudes) ** 2 / best.amplitude_variance, axis=1)
    order = np.argsort(np.sum(np.abs(best.amplitudes), axis=1))
    weak = [k for k in order if gains[k] < CLEAR_GAIN * min_gain]
    for pole in best.poles[weak]:
        nearest = int(np.argmin(np.abs(best.poles - pole)))
        trial = refine(np.delete(best.poles, nearest), spectrum, level, COARSE_TOLERANCE)
        if (
            _weighted_squares(trial.residual, level) - _weighted_squares(best.residual, level)
            < min_gain
        ):
            best = trial
    return best


def _weighted_squares(residual, level) -> float:
    return float(np.sum(np.abs(residual) ** 2 / level))


def _smooth(power, width):
    """Moving sum over `width` bins on either side, shorter at the ends."""
    total = np.cumsum(np.concatenate([np.zeros((1, *power.shape[1:])), power]), axis=0)
    i = np.arange(len(power))
    return total[np.minimum(i + width + 1, len(power))] - total[np.maximum(i - width, 0)]


def _robust_level(residual):
    """Noise level at each bin, from medians, so that modes not yet found stand out."""
    power = np.abs(residual) ** 2
    width = min(2 * NOISE_SMOOTHING_BINS, len(power) // 2)
    padded = np.pad(power, ((width, width), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * width + 1, axis=0)
    return np.median(windows, axis=-1) / np.log(2) + 1e-30 * power.max()


def _initial_pole(spectrum: Spectrum, residual, level) -> complex:
    """The pole that alone explains most of a residual, among candidates near its highest peaks."""
    ratio = np.sum(np.abs(residual) ** 2 / level, axis=1, keepdims=True)
    curves = [_smooth(ratio, width)[:, 0] / np.sqrt(2 * width + 1) for width in (0, 2, 8)]
    peaks = spectrum.bins[[int(np.argmax(curve)) for curve in curves]]
    spacing = 1 / spectrum.duration
    frequencies = np.add.outer(peaks, spacing * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])).ravel()
    rates = spacing * np.array([0.1, 0.5, 1.5, 4.0, 10.0, 30.0])
    poles = np.subtract.outer(2j * np.pi * frequencies[frequencies > 0], rates).ravel()
    columns, _ = _pole_transform(poles, spectrum)
    match = np.abs(columns.conj().T @ (residual / level)) ** 2
    gain = np.sum(match / ((np.abs(columns) ** 2).T @ (1 / level)), axis=1)
    return poles[int(np.argmax(gain))]


def _pole_transform(poles, spectrum: Spectrum):
    """Transform of exp(p t) at every bin in closed form, and its derivative by p (bin, pole)."""
    exponents = (poles - 2j * np.pi * spectrum.bins[:, None]) * spectrum.step
    # exp(-i w N h) is 1 at every bin. An undamped pole at a bin would divide zero by zero.
    exponents = np.where(np.abs(exponents) < 1e-12, 1e-12, exponents)
    numerator, denominator = np.expm1(spectrum.samples * exponents), np.expm1(exponents)
    slope = (
        spectrum.samples * (numerator + 1) / denominator
        - numerator * (denominator + 1) / denominator**2
    )
    return numerator / denominator, spectrum.step * slope


def _nuisance_columns(spectrum: Spectrum, leakage_order=LEAKAGE_ORDER):
    """Columns of a drift over the window, and of leakage from modes outside the band."""
    first = round(spectrum.bins[0] * spectrum.duration)
    return _drift_and_leakage(spectrum.samples, first, spectrum.bins.size, leakage_order)


@functools.lru_cache(maxsize=8)  # of one window a fit asks fifty times, each four long transforms
def _drift_and_leakage(samples: int, first: int, count: int, leakage_order: int):
    time = np.linspace(-1, 1, samples)
    drifts = [
        np.fft.rfft(np.polynomial.Legendre.basis(order)(time))[first : first + count]
        for order in range(1, DRIFT_ORDER + 1)
    ]
    across = np.linspace(-1, 1, count)
    leakage = [across**order * unit for order in range(leakage_order + 1) for unit in (1, 1j)]
    columns = np.stack([*drifts, *leakage], axis=1)
    return columns / np.linalg.norm(columns, axis=0)


def _modal_columns(poles, spectrum: Spectrum):
    """Columns of real and imaginary part of each amplitude, and derivatives by s and w."""
    above, slope_above = _pole_transform(poles, spectrum)
    below, slope_below = _pole_transform(poles.conj(), spectrum)
    columns = np.stack([above + below, 1j * (above - below)], axis=-1) / 2
    by_rate = -np.stack([slope_above + slope_below, 1j * (slope_above - slope_below)], axis=-1) / 2
    by_frequency = (
        np.stack([1j * (slope_above - slope_below), -(slope_above + slope_below)], -1) / 2
    )
    return columns, np.stack([by_rate, by_frequency], axis=2)


def _real_over_imag(columns):
    """Real parts, then imaginary parts, along the first axis."""
    return np.concatenate([columns.real, columns.imag])


def _project_amplitudes(poles, spectrum: Spectrum, weights, nuisance):
    """Weighted residual of the best amplitudes, its Jacobian, amplitudes, model and leverages."""
    columns, slopes = _modal_columns(poles, spectrum)
    bins, count = columns.shape[0], poles.size
    design = np.concatenate([columns.reshape(bins, 2 * count), nuisance], axis=1)
    size = np.linalg.norm(design, axis=0)
    residuals, jacobians, solutions, leverages = [], [], [], []
    for values, weight in zip(spectrum.values.T, weights.T, strict=True):
        basis, r_factor = np.linalg.qr(_real_over_imag(design / size * weight[:, None]))
        data = _real_over_imag(values * weight)
        fitted = basis.T @ data
        solution = np.linalg.lstsq(r_factor, fitted, rcond=1e-12)[0] / size
        real, imag = solution[: 2 * count].reshape(count, 2).T[:, :, None]
        slope_columns = slopes[..., 0] * real + slopes[..., 1] * imag
        slope_columns = _real_over_imag(slope_columns.reshape(bins, 2 * count) * weight[:, None])
        residuals.append(data - basis @ fitted)
        jacobians.append(basis @ (basis.T @ slope_columns) - slope_columns)
        solutions.append(solution)
        leverages.append(np.sum(basis**2, axis=1).reshape(2, bins).sum(axis=0))
    model = columns.reshape(bins, 2 * count) @ np.array(solutions).T[: 2 * count]
    return np.array(residuals), np.array(jacobians), np.array(solutions), model, leverages


def pole_parameters(poles: Complex[np.ndarray, " mode"]) -> Float[np.ndarray, " parameter"]:
    """Decay rate s and angular frequency w (1/s) of each pole: (s_1, w_1, s_2, w_2, ...)."""
    return np.stack([-poles.real, poles.imag], axis=1).ravel()


def _poles_from_parameters(parameters):
    rate, angular_frequency = parameters.reshape(-1, 2).T
    return -rate + 1j * angular_frequency


def refine(
    poles: Complex[np.ndarray, " mode"],
    spectrum: Spectrum,
    level: Float[np.ndarray, "bin channel"],
    accuracy: float = 1e-8,
    leakage_order: int = LEAKAGE_ORDER,
) -> PoleFit:
    """Poles refined together by least squares, weighted by the noise level, in the order given.

    The search ends when a step reduces the squares by less than the fraction `accuracy`.
    `leakage_order` is that of the polynomial for modes outside the band.
    """
    nuisance = _nuisance_columns(spectrum, leakage_order)
    if poles.size:
        duration, weights = spectrum.duration, level**-0.5

        # In units of 1 / duration changes of order one change a spectrum.
        start = pole_parameters(poles) * duration

        @functools.lru_cache(maxsize=1)
        def projected(key):
            moved = start + np.frombuffer(key)
            return _project_amplitudes(
                _poles_from_parameters(moved / duration), spectrum, weights, nuisance
            )

        # Poles stay near their starts: joint fits of many weak ones would drift away. Moves, not
        # parameters, are the unknowns, as the solver's trust region scales with their size.
        max_shift = np.tile([np.inf, 2 * np.pi * MAX_POLE_SHIFT_BINS], poles.size)
        lower_bounds = np.tile([-1.0, 0.0], poles.size) - start
        solved = least_squares(
            lambda moves: projected(moves.tobytes())[0].ravel(),
            np.maximum(np.zeros_like(start), lower_bounds + 1e-9),
            lambda moves: projected(moves.tobytes())[1].reshape(-1, moves.size) / duration,
            (np.maximum(-max_shift, lower_bounds), max_shift),
            ftol=accuracy,
            xtol=1e-8,
            max_nfev=40,
        )
        poles = _poles_from_parameters((start + solved.x) / duration)
        poles = np.where(poles.imag < 0, poles.conj(), poles)
    return _fit_amplitudes(poles, spectrum, level, nuisance)


def with_one_more(fit: PoleFit, spectrum: Spectrum) -> PoleFit:
    """Poles of a fit with one more, which explains most of its residual, refined together."""
    level = _robust_level(fit.residual) + _misfit_level(spectrum)
    guess = _initial_pole(spectrum, fit.residual, level)
    return refine(np.append(fit.poles, guess), spectrum, level, COARSE_TOLERANCE)


def _fit_amplitudes(poles, spectrum: Spectrum, level, nuisance) -> PoleFit:
    """Amplitudes, noise level and covariance at given poles."""
    bins, channels = spectrum.values.shape
    stacked, slopes, solutions, model, leverages = _project_amplitudes(
        poles, spectrum, level**-0.5, nuisance
    )
    weighted = (stacked[:, :bins] + 1j * stacked[:, bins:]).T  # bin, channel
    slopes = slopes[:, :bins] + 1j * slopes[:, bins:]  # channel, bin, parameter
    normal = np.einsum("cjp,cjq->pq", slopes.conj(), slopes, optimize=True).real
    inverse = np.linalg.pinv(normal, hermitian=True) if poles.size else normal
    leverage = np.array(leverages).T  # of the two real numbers of each bin and channel
    leverage = (
        leverage + np.einsum("cjp,pq,cjq->jc", slopes.conj(), inverse, slopes, optimize=True).real
    )
    residual_share = np.maximum(2 - leverage, 0.02) / 2
    count = _smooth(residual_share, NOISE_SMOOTHING_BINS)
    # The residual is averaged without weights, which would keep the shape of the assumed level.
    # Channels have disturbances in common, so their noise is correlated: the score covariance is
    # from local cross-spectra of the residual, the covariance from the sandwich formula.
    residual = weighted * np.sqrt(level)
    cross = _smooth(np.einsum("jc,jd->jcd", residual, residual.conj()), NOISE_SMOOTHING_BINS)
    cross = cross / np.sqrt(count[:, :, None] * count[:, None, :])
    noise = np.einsum("jcc->jc", cross).real + 1e-30 * np.max(np.abs(spectrum.values)) ** 2
    cross = cross / np.sqrt(level[:, :, None] * level[:, None, :])
    score = np.einsum("cjp,jcd,djq->pq", slopes.conj(), cross, slopes, optimize=True).real / 2
    pairs = solutions[:, : 2 * poles.size].reshape(channels, poles.size, 2)
    peaks = np.argmin(np.abs(spectrum.bins[:, None] - poles.imag / (2 * np.pi)), axis=0)
    freedom = 2 * np.min(count[peaks], axis=1)
    # Weights of so few degrees of freedom make the covariance smaller than it is.
    smaller = np.repeat(np.sqrt(freedom / np.maximum(freedom - 2, 1.0)), 2)
    return PoleFit(
        poles=poles,
        covariance=inverse @ score @ inverse * np.multiply.outer(smaller, smaller),
        amplitudes=(pairs[..., 0] + 1j * pairs[..., 1]).T,
        amplitude_variance=_amplitude_variance(poles, spectrum, noise),
        model=model,
        residual=residual,
        noise=noise,
        degrees_of_freedom=freedom,
    )


def _amplitude_variance(poles, spectrum: Spectrum, noise):
    """Variance of each amplitude (mode, channel), as of modes that are well apart."""
    columns = _modal_columns(poles, spectrum)[0]  # bin, mode, 2
    energy = np.sum(np.abs(columns) ** 2, axis=2)
    return 2 / np.maximum(np.einsum("jk,jc->kc", energy / 2, 1 / noise), 1e-300)
