"""Poly-reference least-squares complex frequency method (p-LSCF).

Frequency responses or positive spectra H (output x input) are fitted by a right matrix fraction
B(z) A(z)^-1 of polynomials in z = exp(i w T) with real coefficients, by linear least squares of
B(z) - H A(z) over all lines (Guillaume, Verboven, Vanlanduit, Van der Auweraer and Peeters 2003;
Peeters and Van der Auweraer 2005 for output-only data). With the lowest coefficient of A equal to
the identity, poles that stand for noise are unstable, and fall away.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Complex, Float

from tuning.modal.spectral.impulse_responses import FrequencyResponses


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
