"""Poly-reference least-squares complex frequency method (p-LSCF).

Frequency responses or positive spectra H (output x input) are fitted by a right matrix fraction
B(z) A(z)^-1 of polynomials in z = exp(i w T) with real coefficients, by linear least squares of
B(z) - H A(z) over all lines (Guillaume, Verboven, Vanlanduit, Van der Auweraer and Peeters 2003;
Peeters and Van der Auweraer 2005 for output-only data). With the lowest coefficient of A equal to
the identity, poles that stand for noise are unstable, and fall away.

Correlations of the response to broadband excitation are sums of decaying exponentials, C A^(l-1) G
from the first lag on. Their discrete Fourier transform is rational in z = exp(i w T) with the poles
of the structure at the bins of the transform, though the lags are cut off: as z^N = 1 there, what
is cut off changes numerators only. So there is no leakage, and damping ratios are not biased by a
window (Peeters and Van der Auweraer 2005 fit such positive spectra).

Mode shapes are residues at the poles (least-squares frequency-domain method, LSFD);
uncertainties are those of the blocks of a record.

A wide band is divided into bands of three octaves, each decimated to a rate of its own, as for
subspace identification. Poles of polynomials of rising degree are a stabilisation diagram; shapes
are residues by least squares at the poles that were chosen.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Complex, Float

from tuning.modal.ambient import (
    MAX_ORDER,
    Candidate,
    divided_band,
    mean_square,
    mode_of_chain,
    overlapping,
    without_duplicates,
)
from tuning.modal.preprocessing import RATE_OVER_BAND, Prepared, check_length, prepare
from tuning.modal.result import IdentifiedMode, rejection_reason
from tuning.modal.stabilisation import Chain, Diagram, stabilise
from tuning.modal.subspace import MAX_BLOCKS, MIN_BLOCK_LAGS, Poles, Spread, block_covariances


class ImpulseResponses(NamedTuple):
    """Responses (lag, output, input) at steps of `step` s, and their deviations by blocks.

    Correlations of outputs are such responses, whose inputs are the outputs again. The sum of the
    squares of `changes` over blocks is the variance.
    """

    values: Float[np.ndarray, "lag output input"]
    changes: Float[np.ndarray, "block lag output input"]
    step: float


class FrequencyResponses(NamedTuple):
    """Values (line, output, input) at z = exp(i w T), T = `step` (s), with deviations by blocks."""

    values: Complex[np.ndarray, "line output input"]
    changes: Complex[np.ndarray, "block line output input"]
    z: Complex[np.ndarray, " line"]
    step: float


def output_correlations(
    records: tuple[Float[np.ndarray, "time channel"], ...], rate: float, lags: int
) -> ImpulseResponses:
    """Correlations E y(t + l) y(t)^T of the outputs for l = 0 ... `lags`, of all records."""
    usable = sum(max(len(record) - lags, 0) for record in records)
    wanted = int(np.clip(usable // (MIN_BLOCK_LAGS * lags), 4, MAX_BLOCKS))
    sums, counts = block_covariances(records, lags, wanted)
    total, blocks = counts.sum(), len(counts)
    mean = sums.sum(axis=0) / total
    scale = np.sqrt(blocks / max(blocks - 1, 1))
    changes = scale * (sums - counts[:, None, None, None] * mean) / total
    return ImpulseResponses(mean, changes, 1 / rate)


def frequency_responses(
    responses: ImpulseResponses, band: tuple[float, float]
) -> FrequencyResponses:
    """Discrete Fourier transform of impulse responses at the lines of a band (Hz)."""
    count = len(responses.values)
    bins = np.arange(count) / (count * responses.step)
    lines = np.flatnonzero((bins >= band[0]) & (bins <= min(band[1], 0.5 / responses.step)))
    return FrequencyResponses(
        np.fft.fft(responses.values, axis=0)[lines],
        np.fft.fft(responses.changes, axis=1)[:, lines],
        np.exp(2j * np.pi * bins[lines] * responses.step),
        responses.step,
    )


class Equations(NamedTuple):
    """Least-squares equations of all orders to the highest, after elimination of B.

    `powers` are z^j; `basis` is an orthonormal basis of them (real parts above imaginary parts),
    with the triangular matrix `triangle`; `gram` and `projected` are Y^T Y and the projections of
    Y = -z^j H on the basis, of all outputs.
    """

    responses: FrequencyResponses
    powers: Complex[np.ndarray, "line power"]
    basis: Float[np.ndarray, "row power"]
    triangle: Float[np.ndarray, "power power"]
    gram: Float[np.ndarray, "column column"]
    projected: Float[np.ndarray, "output power column"]


class Fraction(NamedTuple):
    """Denominator A (power, input, input), and what perturbations of it need.

    `poles` in 1/s are those in the upper half plane; `roots` the same as z; `right` and `left` are
    null vectors of A at the roots, `left` conjugated being the participations; `shapes` are
    B(z) v, up to a factor.
    """

    denominator: Float[np.ndarray, "power row column"]
    roots: Complex[np.ndarray, " pole"]
    poles: Complex[np.ndarray, " pole"]
    right: Complex[np.ndarray, "pole input"]
    left: Complex[np.ndarray, "pole input"]
    shapes: Complex[np.ndarray, "pole output"]


def equations(responses: FrequencyResponses, highest: int) -> Equations:
    """Equations of polynomials to degree `highest`."""
    values, inputs = responses.values, responses.values.shape[2]
    powers = responses.z[:, None] ** np.arange(highest + 1)
    basis, triangle = np.linalg.qr(_stacked(powers))
    size = (highest + 1) * inputs
    gram, projected = np.zeros((size, size)), []
    for output in range(values.shape[1]):
        columns = _stacked(
            -(powers[:, :, None] * values[:, output, None, :]).reshape(len(powers), size)
        )
        gram += columns.T @ columns
        projected.append(basis.T @ columns)
    return Equations(responses, powers, basis, triangle, gram, np.stack(projected))


def _stacked(values):
    """Real parts above imaginary parts."""
    return np.concatenate([values.real, values.imag], axis=-2)


def _joined(values):
    """Complex numbers of real parts above imaginary parts."""
    count = values.shape[-2] // 2
    return values[..., :count, :] + 1j * values[..., count:, :]


def _normal_matrix(system: Equations, degree: int):
    inputs = system.responses.values.shape[2]
    size = (degree + 1) * inputs
    part = system.projected[:, : degree + 1, :size].reshape(-1, size)
    return system.gram[:size, :size] - part.T @ part


def fit_fraction(system: Equations, degree: int) -> Fraction:
    """Matrix fraction of a degree, with its poles in the upper half plane."""
    inputs = system.responses.values.shape[2]
    matrix = _normal_matrix(system, degree)
    free = np.linalg.lstsq(matrix[inputs:, inputs:], -matrix[inputs:, :inputs], rcond=1e-15)[0]
    coefficients = np.concatenate([np.eye(inputs), free])
    denominator = coefficients.reshape(degree + 1, inputs, inputs)
    # In powers of 1 / z the leading coefficient is the identity.
    companion = np.eye(degree * inputs, k=-inputs)
    companion[:inputs] = -denominator[1:].transpose(1, 0, 2).reshape(inputs, -1)
    inverse_roots = np.linalg.eigvals(companion)
    inverse_roots = inverse_roots[np.abs(inverse_roots) > 1e-9]
    roots = 1 / inverse_roots[inverse_roots.imag < 0]
    poles = np.log(roots) / system.responses.step
    at_roots = roots[:, None] ** np.arange(degree + 1)
    u, _, vh = np.linalg.svd(np.einsum("rp,pab->rab", at_roots, denominator))
    right, left = vh[:, -1].conj(), u[:, :, -1]
    size = coefficients.shape[0]
    numerator = -scipy.linalg.solve_triangular(
        system.triangle[: degree + 1, : degree + 1],
        (system.projected[:, : degree + 1, :size] @ coefficients).transpose(1, 0, 2).reshape(
            degree + 1, -1
        ),
    ).reshape(degree + 1, -1, inputs)  # fmt: skip
    shapes = np.einsum("rp,poi,ri->ro", at_roots, numerator, right)
    norms = np.maximum(np.linalg.norm(shapes, axis=1, keepdims=True), 1e-300)
    return Fraction(denominator, roots, poles, right, left, shapes / norms)


def pole_changes(system: Equations, fraction: Fraction) -> Complex[np.ndarray, "block pole"]:
    """First-order changes of the poles (1/s) for the deviation of the responses in each block.

    The normal equations M theta = 0 change by dM theta, so that the free coefficients change by
    -M^-1 dM theta, and a root by -w^H dA v / (w^H A' v).
    """
    values, changes = system.responses.values, system.responses.changes
    degree, inputs = len(fraction.denominator) - 1, values.shape[2]
    powers, basis = system.powers[:, : degree + 1], system.basis[:, : degree + 1]
    at_lines = np.einsum("kp,pab->kab", powers, fraction.denominator)

    def rejected(columns):
        """Part of columns (..., line, output, input) that the numerators cannot fit."""
        flat = _stacked(columns.reshape(*columns.shape[:-2], -1))
        return _joined(flat - basis @ (basis.T @ flat)).reshape(columns.shape)

    residual = rejected(-values @ at_lines)
    matrix = _normal_matrix(system, degree)[inputs:, inputs:]
    found = []
    for change in changes:
        moved = rejected(-change @ at_lines)
        weighted = np.swapaxes(values.conj(), 1, 2) @ moved
        weighted += np.swapaxes(change.conj(), 1, 2) @ residual
        right = -np.real(np.tensordot(powers.conj(), weighted, axes=(0, 0)))
        found.append(right[1:].reshape(-1, inputs))
    right = np.stack(found, axis=1).reshape(matrix.shape[0], -1)
    free = -np.linalg.lstsq(matrix, right, rcond=1e-15)[0]
    free = free.reshape(degree, inputs, len(changes), inputs).transpose(2, 0, 1, 3)
    exponents = np.arange(degree + 1)
    at_roots = fraction.roots[:, None] ** exponents
    slopes = exponents * fraction.roots[:, None] ** np.maximum(exponents - 1, 0)
    by_root = np.einsum(
        "ra,rp,pab,rb->r", fraction.left.conj(), slopes, fraction.denominator, fraction.right
    )
    moved = np.einsum(
        "ra,rp,npab,rb->nr", fraction.left.conj(), at_roots[:, 1:], free, fraction.right,
        optimize=True,
    )  # fmt: skip
    root_changes = -moved / by_root
    return root_changes / (fraction.roots * system.responses.step)


def residue_shapes(
    values: Complex[np.ndarray, "line output input"],
    z: Complex[np.ndarray, " line"],
    roots: Complex[np.ndarray, " mode"],
    participations: Complex[np.ndarray, "mode input"],
) -> Complex[np.ndarray, "mode output"]:
    """Shapes psi_r of H = sum_r psi_r l_r^T / (z - z_r) + conjugates + real c_-1 / z + c_0 + c_1 z.

    The last terms, for each output and input, stand for modes outside of the band.
    """
    inputs = values.shape[2]
    one = participations / (z[:, None, None] - roots[:, None])  # line, mode, input
    other = participations.conj() / (z[:, None, None] - roots.conj()[:, None])
    terms = np.concatenate([one + other, 1j * (one - other)], axis=1)
    rest = np.kron(z[:, None, None] ** np.array([-1, 0, 1])[:, None], np.eye(inputs))
    columns = np.concatenate([terms, rest.reshape(len(z), -1, inputs)], axis=1)
    matrix = columns.transpose(0, 2, 1).reshape(len(z) * inputs, -1)
    right = values.transpose(0, 2, 1).reshape(len(z) * inputs, -1)
    found = np.linalg.lstsq(
        np.concatenate([matrix.real, matrix.imag]), np.concatenate([right.real, right.imag]),
        rcond=None,
    )[0]  # fmt: skip
    count = roots.size
    return found[:count] + 1j * found[count : 2 * count]


def shapes_with_covariance(
    responses: FrequencyResponses,
    roots: Complex[np.ndarray, " mode"],
    root_changes: Complex[np.ndarray, "block mode"],
    participations: Complex[np.ndarray, "mode input"],
) -> tuple[Complex[np.ndarray, "mode output"], Float[np.ndarray, "mode part part"]]:
    """Shapes by residues, and the covariance of their real, then imaginary parts.

    Shapes of it have a largest component of one. Deviations of the responses and of the roots in
    each block are carried through the least squares.
    """
    z = responses.z
    shapes = residue_shapes(responses.values, z, roots, participations)
    largest = np.argmax(np.abs(shapes), axis=1)
    rows = np.arange(roots.size)
    unit = shapes / shapes[rows, largest][:, None]
    parts = []
    for change, moved in zip(responses.changes, root_changes, strict=True):
        own = residue_shapes(responses.values + change, z, roots + moved, participations)
        difference = own / own[rows, largest][:, None] - unit
        parts.append(np.concatenate([difference.real, difference.imag], axis=1))
    stacked = np.stack(parts)
    return shapes, np.einsum("bmp,bmq->mpq", stacked, stacked)


def mode_of_best_half(
    poles: Poles,
    chain: Chain,
    spreads: dict[int, Spread],
    scale: Float[np.ndarray, " channel"],
) -> IdentifiedMode:
    """Mode of a chain: the median pole of the half that is determined best.

    The scatter of that half over the degrees adds to its uncertainty, as the choice among them is
    not free of it.
    """
    ranked = sorted(chain.members.tolist(), key=lambda k: np.linalg.det(spreads[k].covariance))
    half = np.array(ranked[: max(len(ranked) // 2, 1)])
    values = poles.poles[half]
    centre = np.median(values.real) + 1j * np.median(values.imag)
    which = half[[np.argmin(np.abs(values - centre))]]
    mode = mode_of_chain(poles, Chain(which, int(which[0])), spreads, scale)
    return mode._replace(
        frequency_sd=float(np.hypot(mode.frequency_sd, poles.frequencies[half].std())),
        damping_sd=float(np.hypot(mode.damping_sd, poles.damping_ratios[half].std())),
    )


def spread_of_changes(
    pole: complex,
    changes: Complex[np.ndarray, " block"],
    shape: Complex[np.ndarray, " channel"],
) -> Spread:
    """Uncertainty of frequency and damping ratio of a pole from its changes by blocks.

    The covariance of the shape is left zero.
    """
    size = np.abs(pole)
    radial = np.real(np.conj(pole) * changes) / size
    by_damping = -changes.real / size + pole.real * radial / size**2
    stacked = np.stack([radial / (2 * np.pi), by_damping], axis=-1)
    parts = 2 * shape.size
    return Spread(
        stacked.T @ stacked,
        shape / shape[np.argmax(np.abs(shape))],
        np.zeros((parts, parts)),
        float(max(len(changes) - 1, 1)),
    )


LAG_CYCLES = 15.0  # cycles of the lowest frequency in the lags of correlations
MIN_LAGS, MAX_LAGS = 32, 1000  # of correlations
RECORD_OVER_LAGS, MIN_RECORD_OVER_LAGS = 8, 3  # of the longest record; at least
MIN_DEGREES = 12  # degrees of the polynomials, however many channels there are


def plscf_modes(
    records: tuple[Float[np.ndarray, "time channel"], ...],
    starts: tuple[float, ...],
    rate: float,
    band: tuple[float, float],
    *,
    order: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[tuple[Candidate, ...], tuple[Diagram, ...]]:
    """Candidate modes and the stabilisation diagram of each part of a band (Hz).

    Raises ValueError for too few samples.
    """
    found: list[Candidate] = []
    diagrams = []
    for low, high in divided_band(band):
        if progress:
            progress(f"modes from {low:.3g} Hz to {high:.4g} Hz")
        prepared = prepare(records, starts, rate, overlapping((low, high), band))
        check_length(prepared, MIN_RECORD_OVER_LAGS * MIN_LAGS, "method 'plscf'")
        candidates, diagram = _modes_of_band(prepared, band, order)
        found += candidates
        diagrams.append(diagram)
    return without_duplicates(found), tuple(diagrams)


def _modes_of_band(prepared: Prepared, whole, order):
    """Candidates and diagram of records prepared for one part of the band `whole`."""
    scale = np.sqrt(mean_square(prepared.records))
    scale = np.where(scale > 0, scale, 1.0)
    records = tuple(record / scale for record in prepared.records)
    most = min(max(map(len, records)) // RECORD_OVER_LAGS, MAX_LAGS)
    lags = max(min(int(LAG_CYCLES * prepared.rate / prepared.band[0]), most), MIN_LAGS)
    correlations = output_correlations(records, prepared.rate, lags)
    lines = prepared.band[0] / 2, 0.45 * RATE_OVER_BAND * prepared.band[1]
    responses = frequency_responses(correlations, lines)
    channels = scale.size
    highest = max(MAX_ORDER // channels, MIN_DEGREES)
    if order is not None:
        highest = max(order // channels, 2)
    degrees = range(1, min(highest, len(responses.z) // 2) + 1)
    system = equations(responses, degrees[-1])
    fractions = [fit_fraction(system, degree) for degree in degrees]
    sizes = [fraction.poles.size for fraction in fractions]
    poles = Poles(
        np.repeat(np.array(degrees) * channels, sizes),
        np.concatenate([fraction.poles for fraction in fractions]),
        np.concatenate([fraction.shapes for fraction in fractions]),
        np.zeros(sum(sizes)),
    )
    diagram = stabilise(poles._replace(shapes=poles.shapes * scale), prepared.band)
    chosen = _Chosen(system, fractions, poles, diagram)
    modes = [mode_of_best_half(poles, chain, chosen.spreads, scale) for chain in diagram.chains]
    if modes:
        modes = _with_residues(modes, chosen, scale, np.diag(correlations.values[0]))
    duration = sum(map(len, records)) / prepared.rate
    candidates = [
        Candidate(mode, rejection_reason(mode, duration, whole), chain.members.size)
        for mode, chain in zip(modes, diagram.chains, strict=True)
    ]
    return candidates, diagram


class _Chosen:
    """Poles of the chains of a diagram: uncertainties, changes by blocks and participations."""

    def __init__(self, system: Equations, fractions: list[Fraction], poles: Poles, diagram):
        self.responses: FrequencyResponses = system.responses
        self.poles = poles
        self.changes: dict[int, np.ndarray] = {}
        self.participations: dict[int, np.ndarray] = {}
        self.spreads: dict[int, Spread] = {}
        members = {int(k) for chain in diagram.chains for k in chain.members}
        first = 0
        for fraction in fractions:
            inside = [k for k in range(first, first + fraction.poles.size) if k in members]
            if inside:
                changes = pole_changes(system, fraction)
                for k in inside:
                    self.changes[k] = changes[:, k - first]
                    self.participations[k] = fraction.left[k - first].conj()
                    self.spreads[k] = spread_of_changes(
                        poles.poles[k], self.changes[k], poles.shapes[k]
                    )
            first += fraction.poles.size

    def member(self, mode: IdentifiedMode) -> int:
        """Index of the pole of a mode."""
        members = np.array(list(self.spreads))
        return int(members[np.argmin(np.abs(self.poles.poles[members] - mode.pole))])


def _with_residues(modes, chosen: _Chosen, scale, variances):
    """Modes with shapes by residues, and their shares in the variances of the outputs."""
    responses = chosen.responses
    members = [chosen.member(mode) for mode in modes]
    poles = chosen.poles.poles[members]
    changes = np.stack([chosen.changes[k] for k in members], axis=1)
    participations = np.stack([chosen.participations[k] for k in members])
    # Responses in the units of the log: shapes and their covariance are in them, too.
    physical = responses._replace(
        values=responses.values * scale[:, None], changes=responses.changes * scale[:, None]
    )
    roots = np.exp(poles * responses.step)
    shapes, covariances = shapes_with_covariance(
        physical, roots, changes * roots * responses.step, participations
    )
    # R_l = sum_r 2 Re(psi_r l_r^T z_r^(l-1)); continued to l = 0 it is the variance without noise.
    own = 2 * np.real(shapes / scale * participations / roots[:, None])
    shares = np.mean(own / np.maximum(variances, 1e-300), axis=1)
    return [
        mode._replace(
            shape=shape / shape[np.argmax(np.abs(shape))],
            shape_covariance=covariance,
            energy_share=float(share),
        )
        for mode, shape, covariance, share in zip(modes, shapes, covariances, shares, strict=True)
    ]
