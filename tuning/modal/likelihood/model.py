"""Expected spectral matrices of modes under random forces, and the fit of the largest likelihood.

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
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Complex, Float

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
