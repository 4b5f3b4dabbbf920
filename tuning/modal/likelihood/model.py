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
positive definite whatever the noise. Shapes tell close modes apart that no single channel does.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float


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
    """Poles p (1/s), shapes f, factor C of the forces, shared forces K, skewness b.

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
