"""Modes that a subspace method leaves uncertain, decided by the likelihood of spectral matrices.

Subspace methods of many channels are hard to beat, but with few channels or close modes damping
ratios scatter several times as much as they must, and a mode may seem to be none. Modes apart
from others are fitted in a window of their own (`model`). Of many channels those principal
combinations count that hold most of the power in the window.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from tuning.modal.likelihood.model import SpectralModel, Window, covariance, maximise

WINDOW_WIDTHS = 8.0  # half width of the window around a pole over its half-power width
WINDOW_FRACTIONS = 0.1, 0.3  # of the frequency, at least and at most
MIN_WINDOW_BINS = 16.0  # likewise in bins of the records
MAX_GROUP = 6  # poles that are fitted together, the best determined ones
MAX_ROWS = 4  # combinations of channels
MIN_POWER = 1e-10  # of the strongest combination; less is rounding
WIDTH_OVER_BINS = 3.0  # half-power width of the narrowest pole over the bins that are averaged
FALSE_ALARM_PROBABILITY = 1e-4  # of a mode in a window that the likelihood gains from by chance
BACKGROUND_ORDERS = 1, 2  # of its factor across a window
SAME_POLE = 0.5  # distance of certain poles over the smaller decay rate, below which they are one
CERTAIN_FIRST = 1e3  # weight of the distances of certain poles from those that the fit has moved
START_POWER = 0.02  # least power of a mode at the start, over that of the window


class Start(NamedTuple):
    """Poles (1/s) and shapes of modes, in order of preference, and their variances.

    A variance is the sum over channels of what a mode contributes. Those that are `certain` are
    not decided here.
    """

    poles: Complex[np.ndarray, " mode"]
    shapes: Float[np.ndarray, "mode channel"]
    variances: Float[np.ndarray, " mode"]
    certain: Bool[np.ndarray, " mode"]


class RefinedMode(NamedTuple):
    """A pole (1/s) with the covariance of its decay rate and angular frequency (1/s), and shape.

    `shape` has a largest component of one, and `variance` is that of the channels by the mode, on
    average.
    """

    pole: complex
    covariance: Float[np.ndarray, "2 2"]
    shape: Float[np.ndarray, " channel"]
    shape_covariance: Float[np.ndarray, "channel channel"]
    variance: float


def refine_modes(
    records: Sequence[Float[np.ndarray, "time channel"]], rate: float, start: Start
) -> list[RefinedMode | None]:
    """Refined modes; None for modes that the likelihood does not need, and for certain ones.

    Certain modes apart from all uncertain ones are left alone.
    """
    found: list[RefinedMode | None] = [None] * start.poles.size
    resolution = rate / max(map(len, records))
    frequencies = start.poles.imag / (2 * np.pi)
    widths = -start.poles.real / (2 * np.pi)
    half = np.clip(WINDOW_WIDTHS * widths, *np.multiply.outer(WINDOW_FRACTIONS, frequencies))
    half = np.maximum(half, MIN_WINDOW_BINS * resolution)
    transforms = [np.fft.rfft(record, axis=0) / np.sqrt(len(record)) for record in records]
    for group in _groups(frequencies, half):
        if start.certain[group].all():
            continue
        low, high = np.min((frequencies - half)[group]), np.max((frequencies + half)[group])
        inside = start.certain & (frequencies > low) & (frequencies < high)
        members = np.union1d(group, np.flatnonzero(inside))[:MAX_GROUP]
        count = max(int(widths[members].min() / resolution / WIDTH_OVER_BINS), 1)
        window = _window(transforms, [len(r) for r in records], rate, (low, high), count)
        if window.frequencies.size * count >= MIN_WINDOW_BINS and window.weights.size:
            some = Start(*(field[members] for field in start))
            for index, one in zip(members, _select(window, some), strict=True):
                found[index] = found[index] or one
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
    return [np.sort(group) for group in groups]


def _window(transforms, sizes, rate, limits, count) -> Window:
    """Matrices of the bins between limits (Hz), `count` neighbours averaged."""
    frequencies, lengths, values = [], [], []
    for transform, size in zip(transforms, sizes, strict=True):
        bins = np.fft.rfftfreq(size, 1 / rate)
        keep = np.flatnonzero((bins > max(limits[0], 0)) & (bins < min(limits[1], 0.49 * rate)))
        keep = keep[: keep.size // count * count].reshape(-1, count)
        frequencies.append(bins[keep].mean(axis=1))
        lengths.append(np.full(len(keep), float(size)))
        values.append(transform[keep])
    values = np.concatenate(values)  # bin, neighbour, channel
    flat = values.reshape(-1, values.shape[2])
    powers, directions = np.linalg.eigh((flat.conj().T @ flat).real)
    weights = directions[:, powers > MIN_POWER * powers[-1]][:, ::-1][:, :MAX_ROWS]
    combined = values @ weights
    spectra = np.einsum("bnc,bnd->bcd", combined, combined.conj()) / count
    return Window(
        np.concatenate(frequencies), np.concatenate(lengths), spectra, weights, count, 1 / rate
    )


def _select(window: Window, start: Start) -> list[RefinedMode | None]:
    """Modes that the likelihood needs, refined."""
    order = _order(window, start)
    best, kept = _certain(window, start, order)
    for k in np.flatnonzero(~start.certain).tolist():
        trial = maximise(_with_pole(best, start, k, window), window)
        if best.cost - trial.cost > _least_gain(trial, window, start.poles.size):
            best, kept = trial, [*kept, k]
    # A mode that filled the place of a later one is not needed any more.
    for k in [k for k in kept if not start.certain[k]][:-1]:
        (trial, others), rest = _certain(window, start, order), [one for one in kept if one != k]
        for one in rest[len(others) :]:
            trial = maximise(_with_pole(trial, start, one, window), window)
        if trial.cost - best.cost < _least_gain(best, window, start.poles.size):
            best, kept = trial, rest
    found: list[RefinedMode | None] = [None] * start.poles.size
    if kept:
        refined = _refined(best, window)
        places = _places(start.poles[kept], start.certain[kept], best.poles)
        for k, place in zip(kept, places, strict=True):
            if not start.certain[k]:
                found[k] = refined[place]
    return found


def _order(window: Window, start: Start) -> int:
    """Order of the background that Schwarz's criterion prefers with the best determined modes.

    These are the certain ones and the first of the others, whose place a background of second
    degree may fill.
    """
    first = np.arange(start.poles.size) == np.argmin(start.certain)
    some = start._replace(certain=start.certain | first)
    rows = len(window.weights.T)
    more = rows * (rows + 1) / 2 * np.log(len(window.frequencies) * window.count) / 2
    costs = [_certain(window, some, order)[0].cost + order * more for order in BACKGROUND_ORDERS]
    return BACKGROUND_ORDERS[int(np.argmin(costs))]


def _certain(window: Window, start: Start, order: int) -> tuple[SpectralModel, list[int]]:
    """Model of the certain modes together, and their indices; of two at one place only one."""
    model, kept = _background(window, order), []
    for k in np.flatnonzero(start.certain).tolist():
        apart = np.abs(start.poles[kept] - start.poles[k])
        if np.all(apart > SAME_POLE * np.minimum(-start.poles[kept].real, -start.poles[k].real)):
            model, kept = _with_pole(model, start, k, window), [*kept, k]
    return maximise(model, window), kept


def _least_gain(model: SpectralModel, window: Window, trials: int) -> float:
    """Gain in log-likelihood that one more mode exceeds by chance with a small probability.

    It may settle on any chance peak in the window, about two for each half-power width.
    """
    count, rows = model.shapes.shape
    unknowns = (
        3 + 2 * rows + count - 1
    )  # pole, skewness, shared forces, shape but for its scale, forces
    narrowest = np.min(-model.poles.real) / (2 * np.pi)
    places = max(2 * np.ptp(window.frequencies) / narrowest, 1.0)
    return float(chi2.isf(FALSE_ALARM_PROBABILITY / (trials * places), unknowns) / 2)


def _places(starts, certain, poles) -> list[int]:
    """Places of the poles that belong to starts, as poles change places on the way.

    Certain ones have the nearest: a start near one of them may have become another mode.
    """
    distance = np.abs(np.subtract.outer(starts, poles)) / -np.add.outer(starts.real, poles.real)
    return linear_sum_assignment(distance * np.where(certain, CERTAIN_FIRST, 1.0)[:, None])[
        1
    ].tolist()


def _background(window: Window, order: int) -> SpectralModel:
    """A model without modes, to begin with."""
    level = window.spectra.mean(axis=0).real
    rows = len(level)
    background = np.zeros((order + 1, rows, rows))
    background[0] = np.linalg.cholesky(level)
    none = np.zeros((0, rows)), np.zeros((0, 0)), np.zeros((0, rows)), np.zeros(0)
    return SpectralModel(np.zeros(0, complex), *none, background, window.step)


def _with_pole(model: SpectralModel, start: Start, k, window: Window) -> SpectralModel:
    """The model with one more pole, whose amplitude is that of its fraction of the energy."""
    count = model.poles.size
    shape = start.shapes[k] @ window.weights
    shape = shape / max(float(np.linalg.norm(shape)), 1e-300)
    forces = np.zeros((count + 1, count + 1))
    forces[:count, :count] = model.forces
    power = np.mean(window.spectra.trace(axis1=1, axis2=2).real / window.lengths)
    power = power * 2 * len(window.frequencies) * window.count
    variance = max(float(start.variances[k]), START_POWER * power)
    forces[count, count] = np.sqrt(-start.poles[k].real * variance)
    return SpectralModel(
        np.append(model.poles, start.poles[k]),
        np.vstack([model.shapes, shape]),
        forces,
        np.vstack([model.shared, np.zeros(len(shape))]),
        np.append(model.skewness, 0.0),
        model.background,
        window.step,
    )


def _refined(model: SpectralModel, window: Window) -> list[RefinedMode]:
    """Modes of a model with their covariances, in all channels."""
    spread, (count, rows) = covariance(model, window), model.shapes.shape
    found = []
    for k, pole in enumerate(model.poles):
        physical = window.weights @ model.shapes[k]
        largest = int(np.argmax(np.abs(physical)))
        first = 3 * count + count * (count + 1) // 2 + (count + k) * rows
        own = slice(first, first + rows)
        unit = physical / physical[largest]
        by_shape = (window.weights - np.outer(unit, window.weights[largest])) / physical[largest]
        variance = 2 * physical * (window.weights @ model.amplitudes[k].real)
        found.append(
            RefinedMode(
                complex(pole),
                spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2],
                unit,
                by_shape @ spread[own, own] @ by_shape.T,
                float(np.mean(variance)),
            )
        )
    return found
