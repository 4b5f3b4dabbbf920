"""The model of the largest likelihood: information, search, covariance."""

import functools

import numpy as np
from jaxtyping import Float

from tuning.modal.likelihood.model import (
    SpectralModel,
    Window,
    across,
    kernel,
    noise_factors,
    spectra_of,
    with_cost,
)
from tuning.modal.likelihood.scoring import damped_scoring

TOLERANCE = 5e-2  # of the logarithm of the likelihood, at which the search ends
MAX_SKEWNESS = 3.0  # over the damping ratio
PART_BINS = 256  # whose derivatives are formed at once
UNKNOWN, MAX_OPEN = 1e100, 1e-6  # variance; share of a pole in such directions
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
    """Largest steps of the unknowns: of forces their size, of others none.

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

    The variance of a pole that is left open is `UNKNOWN`; that scales of shapes are, and that
    forces cannot be told from each other in few channels, does not matter.
    """
    fisher = information(model, window)[1]
    scale = 1 / np.sqrt(np.diag(fisher) + 1e-300)
    sizes, vectors = np.linalg.eigh(fisher * np.multiply.outer(scale, scale))
    known = sizes > MIN_DIRECTION * sizes[-1]
    found = (vectors[:, known] / sizes[known]) @ vectors[:, known].T
    found = found * np.multiply.outer(scale, scale)
    poles = 2 * model.poles.size
    left_open = np.sum(vectors[:poles, ~known] ** 2, axis=1) > MAX_OPEN
    found[np.arange(poles)[left_open], np.arange(poles)[left_open]] = UNKNOWN
    return found
