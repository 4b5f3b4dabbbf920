"""Stochastic subspace identification from output covariances, with uncertainties.

The outputs of a linear structure under broadband excitation have covariances R_l = C A^(l-1) G (l >
0), so that the block Hankel matrix of R_1 ... R_(p+q) is the product of observability and
controllability matrices (Peeters and De Roeck 1999). Its column space gives C, and A by shift
invariance. The data-driven variant weights the columns by the inverse square root of the covariance
of the past outputs, which makes the left singular vectors those of the projection of future on past
outputs (Van Overschee and De Moor 1996, unweighted principal components). The response after an
impact obeys the same equations if each covariance is a sum over the same instants.

Uncertainties are those of the covariances, estimated from blocks of the records, propagated through
singular value decomposition and eigenvalue problem to first order (Pintelon, Guillaume and
Schoukens 2007; Reynders, Pintelon and De Roeck 2008; Doehler and Mevel 2013).

Stabilisation diagram: poles of models of rising order, and the modes among them. A structure's
poles return at every order that is high enough, those of noise do not. Poles of successive orders
are joined to a chain, one of each order at most, if they agree (Peeters and De Roeck 1999 give the
usual limits); the chains that are long enough and determined well enough are the modes (in the
manner of Reynders, Houbrechts and De Roeck 2012, and Neu et al. 2017, with the uncertainties in
place of their clusters of validation criteria).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int
from scipy.fft import next_fast_len

from tuning.modal.result import MAX_DAMPING_RATIO, SAME_MAC, mac_matrix

LOWEST_CYCLES = 8.0  # cycles of the lowest frequency of the band in the lags of half a matrix
MAX_ROWS = 240  # rows of half a Hankel matrix: block rows times channels
MIN_ROWS = 24  # likewise; two thirds of them are the highest order, of which half are even
MIN_BLOCK_ROWS = 8  # of half a Hankel matrix
MAX_BLOCKS = 24  # blocks of the records for the covariance of the covariances
MIN_BLOCK_LAGS = 2  # length of a block over the largest lag


class Subspace(NamedTuple):
    """Singular value decomposition of a Hankel matrix, and perturbations of the matrix by blocks.

    `rotated` holds U^T dH_b V for the deviation of each block from the mean, scaled so that the sum
    of squares over blocks is a variance. `channels` are the rows of a block; `step` is the sampling
    step (s); `total` the variance of each channel.
    """

    left: Float[np.ndarray, "row row"]
    values: Float[np.ndarray, " column"]
    right: Float[np.ndarray, "column column"]
    rotated: Float[np.ndarray, "block row column"]
    channels: int
    step: float
    total: Float[np.ndarray, " channel"]


class Poles(NamedTuple):
    """Poles of the models of one or more orders, in the upper half plane, with their shapes.

    `poles` in 1/s; `shapes` have unit norm; `energies` are the variance of the outputs due to each
    mode over the total variance.
    """

    orders: Int[np.ndarray, " pole"]
    poles: Complex[np.ndarray, " pole"]
    shapes: Complex[np.ndarray, "pole channel"]
    energies: Float[np.ndarray, " pole"]

    @property
    def frequencies(self) -> Float[np.ndarray, " pole"]:
        """Natural frequencies |p| / 2 pi in Hz."""
        return np.abs(self.poles) / (2 * np.pi)

    @property
    def damping_ratios(self) -> Float[np.ndarray, " pole"]:
        """Damping ratios -Re p / |p|."""
        return -self.poles.real / np.maximum(np.abs(self.poles), 1e-300)


class Spread(NamedTuple):
    """Covariance of a pole's frequency (Hz) and damping ratio, and its shape with the covariance.

    The shape has a largest component of one; its covariance is that of real parts, then imaginary
    parts. `degrees_of_freedom` are those of all, for intervals.
    """

    covariance: Float[np.ndarray, "2 2"]
    shape: Complex[np.ndarray, " channel"]
    shape_covariance: Float[np.ndarray, "part part"]
    degrees_of_freedom: float


def block_rows(rate: float, lowest: float, channels: int, samples: int) -> int:
    """Block rows of half a Hankel matrix: lags of eight cycles of the lowest frequency (Hz).

    At most 240 rows with all channels, and so many that a record holds twelve blocks of twice all
    lags; but of one or two channels so many that models have orders enough for modes to be stable
    in, if the record holds three such blocks.
    """
    wanted = int(np.ceil(LOWEST_CYCLES * rate / lowest))
    fewest = min(-(-MIN_ROWS // channels), samples // 12)
    return max(min(wanted, MAX_ROWS // channels, samples // 48), fewest, MIN_BLOCK_ROWS)


def block_covariances(
    records: tuple[Float[np.ndarray, "time channel"], ...], lags: int, blocks: int
) -> tuple[Float[np.ndarray, "block lag channel channel"], Float[np.ndarray, " block"]]:
    """Sums y(t + l) y(t)^T of each block of the records for l = 0 ... lags, and their counts.

    In each record the sums of all lags are over the same instants t.
    """
    usable = np.array([max(len(record) - lags, 0) for record in records], float)
    parts_of_records = np.maximum(np.round(blocks * usable / usable.sum()), usable > 0).astype(int)
    sums, counts = [], []
    for record, parts, count in zip(records, parts_of_records, usable.astype(int), strict=True):
        if parts == 0:
            continue
        size = count // parts
        length = next_fast_len(size + lags, real=True)
        products = np.empty((parts, lags + 1, record.shape[1], record.shape[1]))
        for part in range(parts):
            first = part * size
            later = np.fft.rfft(record[first : first + size + lags], length, axis=0)
            base = np.fft.rfft(record[first : first + size], length, axis=0)
            cross = later[:, :, None] * base[:, None, :].conj()
            products[part] = np.fft.irfft(cross, length, axis=0)[: lags + 1]
        sums.append(products)
        counts.append(np.full(parts, size, float))
    return np.concatenate(sums), np.concatenate(counts)


def decompose(
    records: tuple[Float[np.ndarray, "time channel"], ...],
    rate: float,
    rows: int,
    data_driven: bool = False,
) -> Subspace:
    """Subspace of the Hankel matrix of the output covariances of all records together.

    `rows` are the block rows. Each record is divided into blocks.
    """
    lags = 2 * rows
    total = sum(len(record) for record in records)
    blocks = int(np.clip(total // (MIN_BLOCK_LAGS * lags), 2, MAX_BLOCKS))
    sums, counts = block_covariances(records, lags, blocks)
    mean = sums.sum(axis=0) / counts.sum()
    channels = mean.shape[1]
    index = np.add.outer(np.arange(rows + 1), np.arange(rows)) + 1

    def hankel(covariances):
        return covariances[index].transpose(0, 2, 1, 3).reshape((rows + 1) * channels, -1)

    weight = _past_weight(mean, rows) if data_driven else None

    def weighted(matrix):
        return matrix if weight is None else matrix @ weight

    left, values, right = np.linalg.svd(weighted(hankel(mean)))
    count = len(counts)
    scale = np.sqrt(count / max(count - 1, 1))
    rotated = np.stack(
        [
            scale * (left.T @ weighted(hankel((one - size * mean) / counts.sum()))) @ right.T
            for one, size in zip(sums, counts, strict=True)
        ]
    )
    total_variance = np.einsum("cc->c", mean[0])
    return Subspace(left, values, right.T, rotated, channels, 1 / rate, total_variance)


def _past_weight(mean, rows):
    """Inverse square root of the covariance of the past outputs, a block Toeplitz matrix."""
    channels = mean.shape[1]
    blocks = np.empty((rows, rows, channels, channels))
    for i in range(rows):
        for j in range(rows):
            blocks[i, j] = mean[j - i] if j >= i else mean[i - j].T
    toeplitz = blocks.transpose(0, 2, 1, 3).reshape(rows * channels, -1)
    sizes, vectors = np.linalg.eigh((toeplitz + toeplitz.T) / 2)
    kept = np.maximum(sizes, 1e-10 * sizes[-1])
    return vectors @ (vectors / np.sqrt(kept)).T


class _Realisation(NamedTuple):
    """Model of one order: eigenvalues, right and left eigenvectors, pseudo-inverse and matrix."""

    eigenvalues: Complex[np.ndarray, " state"]
    vectors: Complex[np.ndarray, "state state"]
    lefts: Complex[np.ndarray, "state state"]
    inverse: Float[np.ndarray, "state row"]
    system: Float[np.ndarray, "state state"]


def _realise(subspace: Subspace, order: int) -> _Realisation:
    """State matrix by shift invariance of the first left singular vectors."""
    basis, c = subspace.left[:, :order], subspace.channels
    q, r = np.linalg.qr(basis[:-c])
    inverse = np.linalg.solve(r, q.T)
    system = inverse @ basis[c:]
    eigenvalues, vectors = np.linalg.eig(system)
    return _Realisation(eigenvalues, vectors, np.linalg.pinv(vectors), inverse, system)


def poles_of_order(subspace: Subspace, order: int) -> Poles:
    """Poles of the model of an even order; the state matrix is that of `order` singular vectors."""
    model = _realise(subspace, order)
    keep = (model.eigenvalues.imag > 0) & (np.abs(model.eigenvalues) > 1e-6)
    eigenvalues = model.eigenvalues[keep]
    shapes = (subspace.left[: subspace.channels, :order] @ model.vectors[:, keep]).T
    energies = _energies(subspace, order, eigenvalues, model.vectors[:, keep], model.lefts[keep])
    norms = np.linalg.norm(shapes, axis=1, keepdims=True)
    return Poles(
        np.full(eigenvalues.size, order),
        np.log(eigenvalues) / subspace.step,
        shapes / np.maximum(norms, 1e-300),
        energies,
    )


def spreads(subspace: Subspace, order: int, poles: Complex[np.ndarray, " chosen"]) -> list[Spread]:
    """First-order uncertainties of some poles of the model of an order.

    A perturbation of the singular vectors within their span changes the basis of the state only, so
    that the part outside of it moves poles and shapes:

        u_l^T du_k = (s_k K_lk + s_l K_kl) / (s_k^2 - s_l^2),   K = U^T dH V,   l > order >= k.
    """
    c, step, s = subspace.channels, subspace.step, subspace.values
    model = _realise(subspace, order)
    all_poles = np.log(model.eigenvalues + 0j) / step
    which = np.argmin(np.abs(all_poles[:, None] - poles), axis=0)
    eigenvalues, vectors = model.eigenvalues[which], model.vectors[:, which]
    basis, complement, rank = subspace.left[:, :order], subspace.left[:, order:], s.size
    inner, outer, k = s[:order], s[order:], subspace.rotated
    gap = inner**2 - outer[:, None] ** 2
    gap = np.where(gap <= 1e-12 * s[0] ** 2, np.inf, gap)
    outside = np.empty((len(k), subspace.left.shape[0] - order, order))
    outside[:, : rank - order] = k[:, order:rank, :order] * (inner / gap)
    outside[:, : rank - order] += k[:, :order, order:rank].transpose(0, 2, 1) * (
        outer[:, None] / gap
    )
    outside[:, rank - order :] = k[:, rank:, :order] / np.maximum(inner, 1e-12 * s[0])
    moved = _times(outside, vectors)  # block, complement, pole
    # dA phi = O+ (dO_lower - lambda dO_upper) phi + (O^T O)^-1 dO_upper^T (O_lower - O_upper A) phi
    misfit = complement[:-c].T @ ((basis[c:] - basis[:-c] @ model.system) @ vectors)
    gram = model.inverse @ model.inverse.T
    changes = (model.inverse @ complement[c:]) @ moved
    changes -= eigenvalues * ((model.inverse @ complement[:-c]) @ moved)
    changes += gram @ _times(outside.transpose(0, 2, 1), misfit)
    modal = model.lefts @ changes  # block, state, pole
    found = []
    for i, (state, eigenvalue) in enumerate(zip(which, eigenvalues, strict=True)):
        pole = np.log(eigenvalue + 0j) / step
        pole_changes = modal[:, state, i] / (eigenvalue * step)
        size = np.abs(pole)
        radial = np.real(np.conj(pole) * pole_changes) / size
        by_damping = -pole_changes.real / size + pole.real * radial / size**2
        stacked = np.stack([radial / (2 * np.pi), by_damping], axis=-1)
        # Shape C phi, with the largest component one.
        distance = eigenvalue - model.eigenvalues
        others = np.where(distance == 0, 0, 1 / np.where(distance == 0, 1, distance))
        vector_changes = (modal[:, :, i] * others) @ model.vectors.T
        shape = basis[:c] @ vectors[:, i]
        shape_changes = moved[:, :, i] @ complement[:c].T + vector_changes @ basis[:c].T
        largest = int(np.argmax(np.abs(shape)))
        unit = shape / shape[largest]
        unit_changes = (shape_changes - shape_changes[:, [largest]] * unit) / shape[largest]
        parts = np.concatenate([unit_changes.real, unit_changes.imag], axis=1)
        found.append(Spread(stacked.T @ stacked, unit, parts.T @ parts, float(max(len(k) - 1, 1))))
    return found


def _times(real, complex_matrix):
    """Product of a real array and a complex matrix, as two real products."""
    count = complex_matrix.shape[1]
    both = real @ np.concatenate([complex_matrix.real, complex_matrix.imag], axis=1)
    return both[..., :count] + 1j * both[..., count:]


def _energies(subspace: Subspace, order, eigenvalues, modes, lefts):
    """Fraction of each mode in the variance of outputs, from R_0 = sum_k 2 Re(C m l G / p)."""
    c = subspace.channels
    observed = subspace.left[:c, :order] @ modes
    controlled = lefts @ (subspace.values[:order, None] * subspace.right[:c, :order].T)
    variance = 2 * np.real(observed * controlled.T / eigenvalues)
    scale = np.maximum(subspace.total, 1e-300)
    return np.mean(variance / scale[:, None], axis=0)


MAX_FREQUENCY_CHANGE = 0.01  # relative, between neighbouring orders
MAX_DAMPING_CHANGE = 0.5  # relative to the larger damping ratio
DAMPING_FLOOR = 0.002  # damping ratio added to it
MAX_SKIPPED_ORDERS = 3  # orders in which a chain may lack a pole
MIN_CHAIN_FRACTION = 0.4  # of the orders from its first on
MIN_CHAIN_ORDERS = 6  # likewise


class Chain(NamedTuple):
    """Poles of one mode at successive orders: their indices, and that of the representative."""

    members: Int[np.ndarray, " member"]
    best: int


class Diagram(NamedTuple):
    """Stabilisation diagram: all poles, which of them are stable, and the chains of modes."""

    poles: Poles
    stable: Bool[np.ndarray, " pole"]
    chains: tuple[Chain, ...]
    orders: tuple[int, ...]


def possible(poles: Poles, band: tuple[float, float]) -> Bool[np.ndarray, " pole"]:
    """Mask of the poles that may be modes: damped, by less than 20 %, and in the band (Hz)."""
    damping, frequency = poles.damping_ratios, poles.frequencies
    return (
        (damping > 0)
        & (damping < MAX_DAMPING_RATIO)
        & (frequency >= band[0])
        & (frequency <= band[1])
    )


def stabilise(poles: Poles, band: tuple[float, float]) -> Diagram:
    """Chains of poles of successive orders; `poles` of all orders together."""
    orders = np.unique(poles.orders)
    keep = possible(poles, band)
    chains: list[list[int]] = []
    last: list[int] = []  # index of the order of the last member of each chain
    for step, order in enumerate(orders):
        index = np.flatnonzero(keep & (poles.orders == order))
        open_chains = [i for i, seen in enumerate(last) if step - seen <= MAX_SKIPPED_ORDERS]
        ends = np.array([chains[i][-1] for i in open_chains], int)
        for chain, pole in _pairs(poles, ends, index):
            chains[open_chains[chain]].append(int(index[pole]))
            last[open_chains[chain]] = step
        taken = {chain[-1] for chain in chains}
        for pole in index:
            if int(pole) not in taken:
                chains.append([int(pole)])
                last.append(step)
    found = []
    for chain in chains:
        members = np.array(chain)
        after = np.sum(orders >= poles.orders[members[0]])
        if members.size >= max(MIN_CHAIN_ORDERS, MIN_CHAIN_FRACTION * after):
            found.append(Chain(members, _representative(poles, members)))
    found.sort(key=lambda chain: poles.frequencies[chain.best])
    stable = np.zeros(poles.poles.size, bool)
    for chain in chains:
        if len(chain) >= 3:
            stable[chain] = True
    return Diagram(poles, stable, tuple(found), tuple(int(order) for order in orders))


def _pairs(poles: Poles, ends, index):
    """Pairs (chain, pole) that agree, the nearest first, each used once."""
    if not ends.size or not index.size:
        return []
    distance = _distances(poles, ends, index)
    pairs, used_ends, used = [], set(), set()
    for flat in np.argsort(distance, axis=None):
        chain, pole = divmod(int(flat), index.size)
        if not np.isfinite(distance[chain, pole]):
            break
        if chain not in used_ends and pole not in used:
            pairs.append((chain, pole))
            used_ends.add(chain)
            used.add(pole)
    return pairs


def _distances(poles: Poles, ends, index) -> Float[np.ndarray, "chain pole"]:
    """Relative distance of poles plus 1 - MAC; infinite for pairs that disagree."""
    frequency, damping = poles.frequencies, poles.damping_ratios
    shift = np.abs(frequency[ends][:, None] / frequency[index] - 1)
    change = np.abs(damping[ends][:, None] - damping[index])
    larger = np.maximum(damping[ends][:, None], damping[index]) + DAMPING_FLOOR
    mac = mac_matrix(poles.shapes[ends], poles.shapes[index])
    relative = np.abs(poles.poles[ends][:, None] - poles.poles[index]) / np.abs(poles.poles[index])
    agree = (
        (shift < MAX_FREQUENCY_CHANGE) & (change < MAX_DAMPING_CHANGE * larger) & (mac > SAME_MAC)
    )
    return np.where(agree, relative + 1 - mac, np.inf)


def _representative(poles: Poles, members) -> int:
    """The member nearest to the median pole of the chain."""
    values = poles.poles[members]
    centre = np.median(values.real) + 1j * np.median(values.imag)
    return int(members[np.argmin(np.abs(values - centre))])
