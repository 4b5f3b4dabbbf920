"""Modes that a subspace method leaves uncertain, decided by the likelihood of spectral matrices.

Subspace methods of many channels are hard to beat, but with few channels or close modes damping
ratios scatter several times as much as they must, and a mode may seem to be none. Modes apart from
others are fitted in a window of their own. Of many channels those principal combinations count that
hold most of the power in the window.

The periodogram matrix of a long random response has a complex Wishart distribution about its
expectation, independently from bin to bin (Whittle 1953). The covariance of a structure of real
shapes f_k under white forces, whose modal forces have the spectral matrix S, is a sum over modes,

    R(l) = 2 Re(sum_k f_k c_k^T exp(p_k l h)),   l >= 0,
    c_k = -(1 + i b_k) sum_j S_kj f_j / (p_k + p_j*) + i sqrt(h) L K_k,   S = C C^T + K K^T,

where K_k is the part of the force of mode k that acts on the background B = L L^T, too: flanks of
modes outside the window are a quarter of a period behind. The flank of a mode itself at negative
frequencies skews its peak by b_k = -z_k, z_k or 3 z_k in displacement, velocity or acceleration.
The expectation over N samples is, with the truncation at their ends (Sykulski et al. 2019),

    E(w) = G(w) + G(w)^H + B(w),   G = sum_k f_k (c_k g(p_k) + c_k* g(p_k*) - Re c_k)^T,
    g = sum_l (1 - l / N) z^l = 1 / (1 - z) - z (1 - z^N) / (N (1 - z)^2),   z = exp((p - i w) h),

with R(0) made symmetric. L is lower triangular and a polynomial in log w (in c_k its mean); E is
positive definite whatever the noise. Shapes separate close modes that no single channel does.

The largest likelihood is found by damped Fisher scoring, in which each unknown has its own scale.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

MAX_ITERATIONS = 40  # of scoring
MAX_TRIES, MIN_DAMPING = 10, 1e-6  # of a step, whose damping grows by eight each time

Point = TypeVar("Point")
Information = tuple[Float[np.ndarray, " unknown"], Float[np.ndarray, "unknown unknown"]]


def damped_scoring(
    point: Point,
    cost: float,
    information: Callable[[Point], Information],
    moved: Callable[[Point, Float[np.ndarray, " unknown"]], tuple[Point, float]],
    tolerance: float,
    largest_steps: Callable[[Point, int], Float[np.ndarray, " unknown"] | float] | None = None,
) -> tuple[Point, float]:
    """Minimum of a cost near a start to a `tolerance`, by damped Fisher scoring, and its cost.

    `information` returns the gradient of the cost and Fisher's information at a point, `moved` the
    point after a step of its unknowns with its cost, infinite where it may not be;
    `largest_steps` those of so many unknowns, where they are limited.
    """
    damping = 1e-3
    for _ in range(MAX_ITERATIONS):
        gradient, fisher = information(point)
        scale = 1 / np.sqrt(np.diag(fisher) + 1e-300)
        if largest_steps is not None:
            scale = np.minimum(scale, largest_steps(point, len(fisher)))
        scaled = fisher * np.multiply.outer(scale, scale)
        for _ in range(MAX_TRIES):
            matrix = scaled + damping * np.eye(len(scaled))
            other, found = moved(point, -scale * np.linalg.solve(matrix, scale * gradient))
            if found < cost:
                break
            damping *= 8
        else:
            break
        gain, damping = cost - found, max(damping / 4, MIN_DAMPING)
        point, cost = other, found
        if gain < tolerance:
            break
    return point, cost


class Window(NamedTuple):
    """Periodogram matrices of combined channels in a window, each a mean over `count` bins.

    `frequencies` (Hz) and `lengths`, of the records in samples, are of each bin; `weights` are the
    combinations of the channels, `step` (s) that of sampling.
    """

    frequencies: Float[np.ndarray, " bin"]
    lengths: Float[np.ndarray, " bin"]
    spectra: Complex[np.ndarray, "bin row row"]
    weights: Float[np.ndarray, "channel row"]
    count: int
    step: float


class SpectralModel(NamedTuple):
    """Spectral model: poles p (1/s), shapes f, factor C of the forces, shared forces K, skewness b.

    The factor L of the background is a polynomial. `step` (s) is that of sampling; `cost` is the
    negative logarithm of the likelihood in a window.
    """

    poles: Complex[np.ndarray, " mode"]
    shapes: Float[np.ndarray, "mode row"]
    forces: Float[np.ndarray, "mode mode"]
    shared: Float[np.ndarray, "mode row"]
    skewness: Float[np.ndarray, " mode"]
    background: Float[np.ndarray, "power row row"]
    step: float
    cost: float = np.inf

    @property
    def amplitudes(self) -> Complex[np.ndarray, "mode row"]:
        """Vectors c of the covariance."""
        flanks = np.sqrt(self.step) * self.shared @ self.background[0].T
        return self.by_forces @ self.shapes + 1j * flanks

    @property
    def by_forces(self) -> Complex[np.ndarray, "mode mode"]:
        """Factors -S_kj / (p_k + p_j*) of the shapes."""
        spectrum = self.forces @ self.forces.T + self.shared @ self.shared.T
        sums = np.add.outer(self.poles, self.poles.conj())
        return -spectrum * (1 + 1j * self.skewness[:, None]) / sums

    @property
    def amplitude_slopes(self) -> Complex[np.ndarray, "unknown mode row"]:
        """Derivatives of c by all unknowns, in the order of `information`."""
        count, rows = self.shapes.shape
        own, unit = self.by_forces, np.eye(count)
        sums = np.add.outer(self.poles, self.poles.conj())
        first, second = unit[:, :, None], unit[:, None, :]  # unknown, mode, mode
        by_sum = -own / sums
        poles = np.stack([-(first + second) * by_sum, 1j * (first - second) * by_sum], axis=1)
        low, all_of_shared = np.tril_indices(count), np.indices((count, rows)).reshape(2, -1)
        forces, shared = (
            unit[places[0]][:, :, None] * factor[:, places[1]].T[:, None, :]
            for factor, places in ((self.forces, low), (self.shared, all_of_shared))
        )
        by_factors = np.concatenate([forces, shared])
        skew = 1 + 1j * self.skewness[:, None]
        by_factors = -(by_factors + by_factors.transpose(0, 2, 1)) * skew / sums
        by_skewness = first * (1j * own / skew)
        through = np.concatenate([poles.reshape(2 * count, count, count), by_skewness, by_factors])
        through = through @ self.shapes
        flank = 1j * np.sqrt(self.step)
        k, m = all_of_shared
        through[len(through) - k.size :] += flank * (
            unit[k][:, :, None] * self.background[0][:, m].T[:, None, :]
        )
        shapes = np.einsum("kj,rd->jrkd", own, np.eye(rows)).reshape(count * rows, count, rows)
        low = np.tril_indices(rows)
        by_mean = flank * self.shared[:, low[1]].T[:, :, None] * np.eye(rows)[low[0]][:, None, :]
        others = np.zeros(((len(self.background) - 1) * low[0].size, count, rows))
        return np.concatenate([through, shapes, by_mean, others])


def across(window: Window, count: int) -> Float[np.ndarray, "power bin"]:
    """Powers (power, bin) of the place in a window, on a logarithmic scale from -1 to 1."""
    level = np.log(window.frequencies)
    place = 2 * (level - level.min()) / max(np.ptp(level), 1e-300) - 1
    return place ** np.arange(count)[:, None]


def kernel(
    poles: Complex[np.ndarray, " mode"], window: Window
) -> tuple[Complex[np.ndarray, "mode bin"], Complex[np.ndarray, "mode bin"]]:
    """Truncated transform g of exp(p t) at each bin, and its derivative by p."""
    exponent = (poles[:, None] - 2j * np.pi * window.frequencies) * window.step
    z, last, n = np.exp(exponent), np.exp(exponent * window.lengths), window.lengths
    rest = 1 - z
    value = 1 / rest - z * (1 - last) / (n * rest**2)
    by_z = (1 - (1 - (n + 1) * last) / n) / rest**2 - 2 * z * (1 - last) / (n * rest**3)
    return value, by_z * z * window.step


def expectation(model: SpectralModel, window: Window) -> Complex[np.ndarray, "bin row row"]:
    """Expected periodogram matrices of a model."""
    own = np.einsum("kc,bkd->bcd", model.shapes, spectra_of(model, window))
    noise = noise_factors(model, across(window, len(model.background)))
    return own + own.conj().transpose(0, 2, 1) + noise @ noise.transpose(0, 2, 1)


def noise_factors(
    model: SpectralModel, powers: Float[np.ndarray, "power bin"]
) -> Float[np.ndarray, "bin row row"]:
    """Factors L of the background (bin, row, row)."""
    return np.einsum("qcd,qb->bcd", model.background, powers)


def spectra_of(model: SpectralModel, window: Window) -> Complex[np.ndarray, "bin mode row"]:
    """Vectors (bin, mode, row) whose products with the shapes are the sum G."""
    above, below = kernel(model.poles, window)[0], kernel(model.poles.conj(), window)[0]
    c = model.amplitudes
    return np.einsum("kd,kb->bkd", c.real, above + below - 1) + np.einsum(
        "kd,kb->bkd", 1j * c.imag, above - below
    )


def with_cost(model: SpectralModel, window: Window) -> SpectralModel:
    """The model with its cost; infinite where an expected matrix is not positive definite."""
    expected = expectation(model, window)
    try:
        factors = np.linalg.cholesky(expected)
    except np.linalg.LinAlgError:
        return model._replace(cost=np.inf)
    level = 2 * np.sum(np.log(np.einsum("bcc->bc", factors).real))
    fit = np.sum(np.linalg.solve(expected, window.spectra).trace(axis1=1, axis2=2).real)
    return model._replace(cost=float(window.count * (level + fit)))


TOLERANCE = 5e-2  # of the logarithm of the likelihood, at which the search ends
MAX_SKEWNESS = 3.0  # over the damping ratio
PART_BINS = 256  # whose derivatives are formed at once
UNKNOWN, MAX_OPEN = 1e100, 1e-6  # variance; squared component of a pole in such directions
MIN_DIRECTION = 1e-10  # of the scaled information; the scales of shapes have none


def information(
    model: SpectralModel, window: Window
) -> tuple[Float[np.ndarray, " unknown"], Float[np.ndarray, "unknown unknown"]]:
    """Gradient of the cost, and Fisher's information, by all unknowns.

    These are decay rates and angular frequencies (1/s), pole by pole, skewness, forces (lower
    triangle), shared forces, shapes, and factors of the background (lower triangles).
    """
    gradient, fisher = np.zeros(1), np.zeros((1, 1))
    for first in range(0, len(window.frequencies), PART_BINS):
        slopes, errors = _derivatives(model, window, slice(first, first + PART_BINS))
        gradient, fisher = gradient + slopes @ errors, fisher + slopes @ slopes.T
    return window.count * gradient, window.count * fisher


def _derivatives(model: SpectralModel, window: Window, part: slice):
    """L^-1 dE L^-H (unknown, entry) of some bins and I - L^-1 S L^-H, where E = L L^H.

    Entries are real and imaginary parts of all bins and places.
    """
    powers = across(window, len(model.background))[:, part]
    window = window._replace(
        frequencies=window.frequencies[part],
        lengths=window.lengths[part],
        spectra=window.spectra[part],
    )
    count, rows = model.shapes.shape
    vectors = spectra_of(model, window)
    expected = np.einsum("kc,bkd->bcd", model.shapes, vectors)
    expected = expected + expected.conj().transpose(0, 2, 1)
    factors = noise_factors(model, powers)
    expected = expected + factors @ factors.transpose(0, 2, 1)
    inverse = np.linalg.inv(np.linalg.cholesky(expected))
    white = inverse @ model.shapes.T  # bin, row, mode
    (above, d_above), (below, d_below) = (
        kernel(poles, window) for poles in (model.poles, model.poles.conj())
    )
    c, slopes = model.amplitudes, model.amplitude_slopes
    both, apart = (d_above + d_below)[..., None], (d_above - d_below)[..., None]
    real, imaginary = c.real[:, None], c.imag[:, None]  # mode, bin, row
    by_decay = -real * both - 1j * imaginary * apart
    by_frequency = 1j * real * apart - imaginary * both
    changes = np.einsum("ukd,kb->ukbd", slopes.real, above + below - 1)
    changes = changes + np.einsum("ukd,kb->ukbd", 1j * slopes.imag, above - below)
    for k in range(count):
        changes[2 * k, k] += by_decay[k]
        changes[2 * k + 1, k] += by_frequency[k]
    turned = np.einsum("ukbd,bed->ukbe", changes, inverse.conj(), optimize=True)
    through = np.einsum("bck,ukbe->ubce", white, turned, optimize=True)
    direct = np.einsum("bcr,bed,bkd->krbce", inverse, inverse.conj(), vectors, optimize=True)
    direct = direct.reshape(count * rows, *direct.shape[2:])
    low = np.tril_indices(rows)
    turned = inverse.conj() @ factors
    noise = np.einsum("bci,bdi->ibcd", inverse[:, :, low[0]], turned[:, :, low[1]])
    noise = np.einsum("qb,ibcd->qibcd", powers, noise)
    size = (-1, len(expected), rows, rows)
    halves = through
    noise = noise.reshape(size)
    halves[len(halves) - len(noise) - len(direct) : len(halves) - len(noise)] += direct
    halves[len(halves) - len(noise) :] += noise
    whole = (halves + halves.conj().swapaxes(2, 3)).reshape(len(halves), -1)
    errors = np.eye(rows) - inverse @ window.spectra @ inverse.conj().transpose(0, 2, 1)
    errors = errors.reshape(-1)
    return (
        np.concatenate([whole.real, whole.imag], axis=1),
        np.concatenate([errors.real, errors.imag]),
    )


def _moved(model: SpectralModel, step) -> SpectralModel:
    """The model with a step of its unknowns."""
    count, rows = model.shapes.shape
    sizes = np.cumsum([2 * count, count, count * (count + 1) // 2, count * rows, count * rows])
    poles, skewness, forces, shared, shapes, background = np.split(step, sizes)
    low, own = np.tril_indices(rows), np.tril_indices(count)
    change, by_force = np.zeros_like(model.background), np.zeros((count, count))
    change[:, low[0], low[1]] = background.reshape(len(change), -1)
    by_force[own] = forces
    moved = model.poles - poles[::2] + 1j * poles[1::2]
    widest = MAX_SKEWNESS * np.abs(moved.real) / np.abs(moved)
    return SpectralModel(
        moved,
        model.shapes + shapes.reshape(model.shapes.shape),
        model.forces + by_force,
        model.shared + shared.reshape(model.shapes.shape),
        np.clip(model.skewness + skewness, -widest, widest),
        model.background + change,
        model.step,
    )


def _largest_steps(model: SpectralModel, size: int):
    """Largest steps of the unknowns: the size of forces, unlimited for the others.

    Where forces are fully correlated the diagonal of their factor is zero, and the cost flat in it.
    """
    rows, first = np.tril_indices(model.poles.size)[0], 3 * model.poles.size
    found = np.full(size, np.inf)
    found[first : first + rows.size] = np.linalg.norm(model.forces, axis=1)[rows]
    return found


def maximise(model: SpectralModel, window: Window) -> SpectralModel:
    """The model of the largest likelihood near a model, by damped Fisher scoring.

    Poles stay in the window and damped.
    """
    low, high = 2 * np.pi * window.frequencies.min(), 2 * np.pi * window.frequencies.max()

    def moved(model: SpectralModel, step):
        other = _moved(model, step)
        inside = (other.poles.imag > low) & (other.poles.imag < high)
        if np.all(inside & (other.poles.real < 0)):
            other = with_cost(other, window)
        return other, other.cost

    start = with_cost(model, window)
    search = functools.partial(information, window=window), moved, TOLERANCE, _largest_steps
    return damped_scoring(start, start.cost, *search)[0]


def covariance(model: SpectralModel, window: Window) -> Float[np.ndarray, "unknown unknown"]:
    """Covariance of all unknowns, in the order of `information`.

    The variance of a pole that is not determined is `UNKNOWN`. Scales of shapes, and in few
    channels the division between forces, are not determined either, which does not matter.
    """
    fisher = information(model, window)[1]
    scale = 1 / np.sqrt(np.diag(fisher) + 1e-300)
    sizes, vectors = np.linalg.eigh(fisher * np.multiply.outer(scale, scale))
    determined = sizes > MIN_DIRECTION * sizes[-1]
    found = (vectors[:, determined] / sizes[determined]) @ vectors[:, determined].T
    found = found * np.multiply.outer(scale, scale)
    poles = 2 * model.poles.size
    left_open = np.sum(vectors[:poles, ~determined] ** 2, axis=1) > MAX_OPEN
    found[np.arange(poles)[left_open], np.arange(poles)[left_open]] = UNKNOWN
    return found


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
