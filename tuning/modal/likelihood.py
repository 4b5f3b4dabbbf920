"""Modes that a subspace method leaves uncertain, decided by the likelihood of periodograms.

Subspace methods of many channels are hard to beat, but with few channels or close modes damping
ratios scatter twice as much as they must, and a mode may not be told from none. The periodogram of
a long random response is exponentially distributed about its expectation, independently from bin to
bin (Whittle 1953). The covariance function of a structure under white forces is a sum over its
modes, whatever the correlation of the modal forces,

    R(l) = Re(sum_k r_k exp(p_k l h)),   l >= 0,

so that the expectation over N samples is, with the truncation at their ends (Sykulski et al. 2019),

    E(w) = Re(sum_k r_k g(p_k, w) + r_k* g(p_k*, w)) - Re(sum_k r_k),
    g = sum_l (1 - l / N) z^l = 1 / (1 - z) - z (1 - z^N) / (N (1 - z)^2),   z = exp((p - i w) h).

Modes apart from others are fitted in a window of their own, with a smooth background for the noise
and all others. Of several channels there count their two principal combinations in the window, and
those that show one of the two best determined modes without the other. Combinations are added as if
independent; the covariance takes account of their coherence (sandwich formula).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.stats import chi2

WINDOW_WIDTHS = 8.0  # half width of the window around a pole over its half-power width
MIN_WINDOW_BINS = 16.0  # likewise in bins of the records
MAX_GROUP = 12  # poles that are fitted together, the best determined ones
BACKGROUND_ORDER = 2  # of its polynomial across a window
FALSE_ALARM_PROBABILITY = 1e-4  # of a mode in a window that the likelihood gains from by chance
MAX_ITERATIONS = 40
TOLERANCE = 1e-3  # of the logarithm of the likelihood, at which the search ends


class RefinedPole(NamedTuple):
    """A pole (1/s) with the covariance of its decay rate and angular frequency (1/s)."""

    pole: complex
    covariance: Float[np.ndarray, "2 2"]


class _Window(NamedTuple):
    """Periodograms (channel, bin) of combined channels, frequencies (Hz) and record lengths."""

    frequencies: Float[np.ndarray, " bin"]
    lengths: Float[np.ndarray, " bin"]
    power: Float[np.ndarray, "channel bin"]
    step: float


class _Fit(NamedTuple):
    """Poles, amplitudes of all columns, and the negative logarithm of the likelihood."""

    poles: Complex[np.ndarray, " mode"]
    linear: Float[np.ndarray, "channel column"]
    cost: float


def refine_poles(
    records: Sequence[Float[np.ndarray, "time channel"]],
    rate: float,
    poles: Complex[np.ndarray, " mode"],
    shapes: Float[np.ndarray, "mode channel"],
    certain: Bool[np.ndarray, " mode"],
) -> list[RefinedPole | None]:
    """Each pole (1/s) refined, None if the likelihood does not need it.

    `poles` come in order of preference: of two that stand for one mode the first stays. Those that
    are `certain` stay whatever they gain.
    """
    found: list[RefinedPole | None] = [None] * poles.size
    resolution = rate / max(map(len, records))
    frequencies = poles.imag / (2 * np.pi)
    half = np.maximum(
        WINDOW_WIDTHS * np.abs(poles.real) / (2 * np.pi), MIN_WINDOW_BINS * resolution
    )
    transforms = [np.fft.rfft(record, axis=0) / np.sqrt(len(record)) for record in records]
    for members in _groups(frequencies, half):
        limits = np.min((frequencies - half)[members]), np.max((frequencies + half)[members])
        window = _window(records, transforms, rate, limits, shapes[members])
        if window.frequencies.size >= MIN_WINDOW_BINS:
            for index, one in zip(*_select(window, poles[members], members, certain), strict=True):
                found[index] = one
    return found


def _groups(frequencies, half):
    """Indices of poles whose half windows overlap, those of each group in order of preference."""
    groups: list[list[int]] = []
    reach = -np.inf
    for k in np.argsort(frequencies):
        if frequencies[k] - half[k] / 2 < reach:
            groups[-1].append(int(k))
        else:
            groups.append([int(k)])
        reach = max(reach, frequencies[k] + half[k] / 2)
    return [np.sort(group)[:MAX_GROUP] for group in groups]


def _window(records, transforms, rate, limits, shapes) -> _Window:
    frequencies, lengths, values = [], [], []
    for record, transform in zip(records, transforms, strict=True):
        bins = np.fft.rfftfreq(len(record), 1 / rate)
        keep = (bins > max(limits[0], 0)) & (bins < min(limits[1], 0.49 * rate))
        frequencies.append(bins[keep])
        lengths.append(np.full(keep.sum(), float(len(record))))
        values.append(transform[keep])
    values = np.concatenate(values)
    weights = np.linalg.eigh((values.conj().T @ values).real)[1][:, ::-1][:, :2]
    if len(shapes) > 1 and values.shape[1] > 1:
        weights = np.concatenate([weights, np.linalg.pinv(shapes[:2])], axis=1)
    power = np.abs(values @ weights).T ** 2
    scale = np.maximum(power.mean(axis=1, keepdims=True), 1e-300)
    return _Window(np.concatenate(frequencies), np.concatenate(lengths), power / scale, 1 / rate)


def _select(window: _Window, candidates, members, certain):
    """Members that the likelihood needs, and their refined poles."""
    best, kept = _maximise(None, None, window), []
    for index, pole in zip(members, candidates, strict=True):
        trial = _maximise(best, pole, window)
        # Coherent channels repeat each other: gain and degrees of freedom are fewer.
        repeats = np.linalg.eigvalsh(_coherence(trial, window))[-1]
        freedom = 2 + 2 * len(window.power) / repeats
        least = chi2.isf(FALSE_ALARM_PROBABILITY / members.size, freedom) / 2
        if certain[index] or (best.cost - trial.cost) / repeats > least:
            best, kept = trial, [*kept, int(index)]
    if not kept:
        return [], []
    covariance = _covariance(best, window)
    return kept, [
        RefinedPole(complex(pole), covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2])
        for k, pole in enumerate(best.poles)
    ]


def _kernel(pole, window: _Window):
    """Truncated transform g of exp(p t) at each bin, and its derivative by p."""
    exponent = (pole - 2j * np.pi * window.frequencies) * window.step
    z, last, n = np.exp(exponent), np.exp(exponent * window.lengths), window.lengths
    rest = 1 - z
    value = 1 / rest - z * (1 - last) / (n * rest**2)
    by_z = (1 - (1 - (n + 1) * last) / n) / rest**2 - 2 * z * (1 - last) / (n * rest**3)
    return value, by_z * z * window.step


def _columns(poles, window: _Window):
    """Columns of the expectation (column, bin), and derivatives of those of poles by them.

    Two columns for each pole (real and imaginary part of its amplitude), then the background.
    Derivatives (pole, 2, column, bin) are by decay rate s and angular frequency w, p = -s + i w.
    """
    columns, slopes = [], []
    for pole in poles:
        (above, by_above), (below, by_below) = _kernel(pole, window), _kernel(pole.conj(), window)
        columns += [(above + below).real - 1, (below - above).imag]
        total, difference = by_above + by_below, by_below - by_above
        slopes.append([[-total.real, -difference.imag], [difference.imag, -total.real]])
    low, high = window.frequencies.min(), window.frequencies.max()
    across = 2 * (window.frequencies - low) / (high - low) - 1
    columns += [across**order for order in range(BACKGROUND_ORDER + 1)]
    return np.array(columns), np.array(slopes).reshape(len(poles), 2, 2, across.size)


def _cost(columns, linear, power):
    model = linear @ columns
    if np.any(model <= 0):
        return np.inf, model
    return float(np.sum(np.log(model) + power / model)), model


def _maximise(best: _Fit | None, pole, window: _Window) -> _Fit:
    """The fit of the largest likelihood with one more pole, by damped Fisher scoring."""
    poles, linear, columns, slopes = _start(best, pole, window)
    cost, model = _cost(columns, linear, window.power)
    count, damping = poles.size, 1e-3
    for _ in range(MAX_ITERATIONS):
        relative = _relative(slopes, columns, linear, model).reshape(2 * count + linear.size, -1)
        gradient = relative @ (1 - window.power / model).ravel()
        fisher = relative @ relative.T
        for _ in range(8):
            matrix = fisher + damping * np.diag(np.diag(fisher) + 1e-300)
            step = -np.linalg.lstsq(matrix, gradient, rcond=1e-14)[0]
            moved = poles + (-step[: 2 * count : 2] + 1j * step[1 : 2 * count : 2])
            new_cost, new_linear = np.inf, linear + step[2 * count :].reshape(linear.shape)
            if np.all(moved.real < 0) and np.all(moved.imag > 0):
                new_columns, new_slopes = _columns(moved, window)
                new_cost, new_model = _cost(new_columns, new_linear, window.power)
            if new_cost < cost:
                break
            damping *= 8
        else:
            break
        gain, cost, damping = cost - new_cost, new_cost, damping / 4
        poles, linear, columns, slopes, model = (
            moved,
            new_linear,
            new_columns,
            new_slopes,
            new_model,
        )
        if gain < TOLERANCE:
            break
    return _Fit(poles, linear, cost)


def _start(best: _Fit | None, pole, window: _Window):
    """Poles, amplitudes and columns to begin with: a background, and a peak at a new pole."""
    poles = np.zeros(0, complex) if best is None else np.append(best.poles, pole)
    columns, slopes = _columns(poles, window)
    linear = np.zeros((len(window.power), len(columns)))
    if best is None:
        linear[:, 0] = 1.0
        return poles, linear, columns, slopes
    new = 2 * poles.size - 2
    linear[:, :new], linear[:, new + 2 :] = best.linear[:, :new], best.linear[:, new:]
    weight = np.maximum(columns[new], 0.0) ** 2
    above = (window.power - linear @ columns) @ weight / (columns[new] @ weight)
    linear[:, new] = np.maximum(above, 0.05 / columns[new].max())
    while np.any(linear @ columns <= 0):
        linear[:, new + 2] *= 2
    return poles, linear, columns, slopes


def _relative(slopes, columns, linear, model):
    """Derivatives of the logarithm of the model (parameter, channel, bin)."""
    channels, size = linear.shape
    count = len(slopes)
    found = np.zeros((2 * count + linear.size, channels, columns.shape[1]))
    pairs = linear[:, : 2 * count].reshape(channels, count, 2)
    by_poles = np.einsum("kpaj,cka->kpcj", slopes, pairs)
    found[: 2 * count] = by_poles.reshape(2 * count, channels, columns.shape[1])
    for c in range(channels):
        found[2 * count + c * size : 2 * count + (c + 1) * size, c] = columns
    return found / model


def _coherence(fit: _Fit, window: _Window):
    """Correlation of the relative errors of the periodograms of the channels."""
    columns, _ = _columns(fit.poles, window)
    errors = window.power / (fit.linear @ columns) - 1
    coherence = np.clip(errors @ errors.T / errors.shape[1], 0, 1)
    np.fill_diagonal(coherence, 1.0)
    return coherence


def _covariance(fit: _Fit, window: _Window):
    """Covariance of all decay rates and frequencies, with the coherence of the channels."""
    columns, slopes = _columns(fit.poles, window)
    relative = _relative(slopes, columns, fit.linear, fit.linear @ columns)
    flat = relative.reshape(len(relative), -1)
    inverse = np.linalg.pinv(flat @ flat.T, hermitian=True, rcond=1e-13)
    mixed = np.einsum("cd,qdj->qcj", _coherence(fit, window), relative).reshape(flat.shape)
    return (inverse @ (flat @ mixed.T) @ inverse)[: 2 * fit.poles.size, : 2 * fit.poles.size]
