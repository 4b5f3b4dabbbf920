"""Modal model of responses to measured forces, refined by maximum likelihood.

Responses Y = sum_r R_r U / (i w - p_r) + x_r / (z - z_r) + conjugates + rest are linear in the
residues R_r and the transients x_r of the samples, z_r = exp(p_r T). Their errors are minimised
over the poles p_r by Gauss-Newton steps with the residues eliminated: the likelihood of output
errors of one variance for each output (El-Kafafy, De Troyer, Peeters and Guillaume 2013). Shapes
are the residues by least squares (LSFD), of rank one: shape times participation.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from tuning.modal.forced.common_denominator import Lines
from tuning.modal.forced.terms import (
    both_parts,
    columns_of_model,
    columns_of_poles,
    pole_directions,
)
from tuning.modal.forced.uncertainty import (
    FreeErrors,
    degrees_of_freedom,
    error_spread,
    free_errors,
)

REST_POWERS = (-2, -1, 0, 1, 2)  # of z, for modes above the band and those not found
REST_TERMS = len(REST_POWERS) + 2  # with those of modes below the band
FEWER_REST_POWERS = (0, 1)  # with which poles are compared
STEPS = 12
WIDE = 16  # lines on either side whose errors tell the level of a line
MIN_SPREAD = 1e-3  # of errors, over that of all lines
MIN_PIVOT = (
    1e-4  # of Cholesky's factor, whose relative errors are those of rounding over its square
)
MAX_STEP = 0.5  # of a pole, over its width
CONVERGED = 1e-4  # step over the decay rate; what is left after it is of the order of its square
MAX_SHIFT = 3.0  # from the start, over the width; beyond, a pole is none of the data
MIN_WIDTH = 0.5  # of a pole, over the distance of lines: less is not told from nothing


class LinearFit(NamedTuple):
    """Columns of the linear least squares, coefficients and errors.

    `basis` is orthonormal; `inverse_factor` times its transpose is the pseudo-inverse of columns.
    """

    columns: Float[np.ndarray, "row column"]
    basis: Float[np.ndarray, "row column"]
    inverse_factor: Float[np.ndarray, "column column"]
    found: Float[np.ndarray, "column output"]
    errors: Float[np.ndarray, "row output"]

    @property
    def inverse(self) -> Float[np.ndarray, "column row"]:
        """Pseudo-inverse of the columns."""
        return self.inverse_factor @ self.basis.T


class FittedModel(NamedTuple):
    """Poles that fit the lines of a band best, and what tests and uncertainties need.

    `plain` are the lines as they are, `lines` those with errors of one level; poles with indices
    `moving` were refined. Slopes are those of the responses and of the coefficients by the poles,
    `weight` is that of the outputs, `normal` the matrix of the normal equations of the poles;
    `model_errors` (1/s) are changes of real, then imaginary parts of moving poles with fewer terms
    for other modes.
    """

    plain: Lines
    lines: Lines
    poles: Complex[np.ndarray, " mode"]
    moving: Int[np.ndarray, " moving"]
    fit: LinearFit
    slopes: Float[np.ndarray, "row part output"]
    by_poles: Float[np.ndarray, "column part output"]
    weight: Float[np.ndarray, " output"]
    normal: Float[np.ndarray, "part part"]
    free: FreeErrors
    model_errors: Float[np.ndarray, " part"]

    def peak(self, k: int) -> int:
        """Line nearest to the k-th pole."""
        return self.peak_at(complex(self.poles[k]))

    def freedom(self, k: int) -> float:
        """Degrees of freedom of the errors about the k-th pole."""
        return self.freedom_at(complex(self.poles[k]))

    def peak_at(self, pole: complex) -> int:
        """Line nearest to a pole."""
        return int(np.argmin(np.abs(np.angle(self.lines.z) / self.lines.step - pole.imag)))

    def freedom_at(self, pole: complex) -> float:
        """Degrees of freedom of the errors about a pole."""
        width = 2 * abs(pole.real) / self.lines.spacing
        return degrees_of_freedom(self.free, self.peak_at(pole), width)


def fit_modal_model(
    lines: Lines, starts: Complex[np.ndarray, " mode"], band: tuple[float, float]
) -> FittedModel:
    """Modal model at the lines within a band (Hz), from poles (1/s) to start from.

    Only poles in the band are refined, first with equal weights of the lines, then with those of
    the errors.
    """
    frequencies = np.angle(lines.z) / (2 * np.pi * lines.step)
    inside = (frequencies >= band[0]) & (frequencies <= band[1])
    plain = lines._replace(
        outputs=lines.outputs[inside], inputs=lines.inputs[inside], z=lines.z[inside],
        record=lines.record[inside],
    )  # fmt: skip
    natural = np.abs(starts) / (2 * np.pi)
    moving = np.flatnonzero((natural >= band[0]) & (natural <= band[1]))
    poles = refined_poles(plain, starts, moving)
    lines = whitened(plain, poles)
    poles = refined_poles(lines, poles, moving)
    fewer = refined_poles(lines, poles, moving, FEWER_REST_POWERS)
    others = fewer[moving] - poles[moving]
    fit = linear_fit(lines, poles)
    columns = both_parts(columns_of_poles(lines, poles[moving]))
    inside = fit.basis.T @ columns
    directions = pole_directions(lines, fit.found, poles.size, moving)
    slopes = np.einsum("rc,cko->rko", columns - fit.basis @ inside, directions, optimize=True)
    by_poles = np.tensordot(fit.inverse_factor @ inside, directions, axes=1)
    weight = 1 / np.maximum(np.mean(fit.errors**2, axis=0), 1e-300)
    normal = _normal(columns.T @ columns - inside.T @ inside, directions, weight)
    free = free_errors(fit.errors, fit.columns, fit.inverse, slopes, normal, weight)
    return FittedModel(
        plain, lines, poles, moving, fit, slopes, by_poles, weight, normal, free,
        np.concatenate([others.real, others.imag]),
    )  # fmt: skip


def _normal(gram, directions, weight):
    """Matrix of the normal equations of the poles.

    Slopes by the poles are columns in some `directions`; `gram` has their products, less what
    residues make up for.
    """
    return np.einsum("cko,cd,dlo,o->kl", directions, gram, directions, weight, optimize=True)


def refined_poles(
    lines: Lines,
    starts: Complex[np.ndarray, " mode"],
    moving: Int[np.ndarray, " moving"],
    powers: tuple[int, ...] = REST_POWERS,
    steps: int = STEPS,
) -> Complex[np.ndarray, " mode"]:
    """Poles after Gauss-Newton steps; those that leave their surroundings return to the start."""
    poles = starts.astype(complex)
    least = MIN_WIDTH * lines.spacing
    for _ in range(steps if moving.size else 0):
        found, gram, along, squares = _reduced(lines, poles, moving, powers)
        directions = pole_directions(lines, found, poles.size, moving)
        weight = 2 * len(lines.z) / np.maximum(squares, 1e-300)
        right = np.einsum("cko,co,o->k", directions, along, weight, optimize=True)
        step = np.linalg.lstsq(_normal(gram, directions, weight), right, rcond=1e-12)[0]
        change = step[: moving.size] + 1j * step[moving.size :]
        # A pole with hardly any decay could not leave it by steps of its decay rate.
        limit = MAX_STEP * np.maximum(np.abs(poles[moving].real), least)
        change *= np.minimum(1, limit / np.maximum(np.abs(change), 1e-300))
        rise = np.minimum(change.real, MAX_STEP * np.abs(poles[moving].real))
        poles[moving] += rise + 1j * change.imag
        far = np.abs(poles - starts) > MAX_SHIFT * np.maximum(np.abs(starts.real), least)
        lost = far | (poles.real >= 0)
        poles[lost] = starts[lost]
        if np.all(np.abs(change) < CONVERGED * np.abs(poles[moving].real)):
            break
    return poles


def _reduced(lines: Lines, poles, moving, powers):
    """What a step of Gauss-Newton needs of all lines.

    These are the coefficients (column, output), the products of the columns of the moving poles,
    less what residues make up for, their products with the errors (column, output), and the sums of
    squared errors. All follow from the triangular factor of the columns and outputs side by side.
    """
    columns, slopes = columns_of_model(lines, poles, powers), columns_of_poles(lines, poles[moving])
    factor = triangular_factor(np.concatenate([columns, slopes, lines.outputs], axis=1))
    first, second = columns.shape[1], columns.shape[1] + slopes.shape[1]
    found = np.linalg.lstsq(factor[:first, :first], factor[:first, second:], rcond=1e-15)[0]
    own, errors = factor[first:second, first:second], factor[first:, second:]
    along = own.T @ errors[: second - first]
    return found, own.T @ own, along, np.sum(errors**2, axis=0)


def triangular_factor(
    columns: Complex[np.ndarray, "line column"],
) -> Float[np.ndarray, "column column"]:
    """Upper triangular R of the QR decomposition of real and imaginary parts of columns.

    It is Cholesky's factor of the products of all columns, which costs half as much, unless columns
    of unit size depend on those before them but for MIN_PIVOT: products lose their difference.
    """
    rows = np.ascontiguousarray(columns.T).view(float)
    products = rows @ rows.T
    size = np.sqrt(np.maximum(np.diag(products), 1e-300))
    try:
        factor = np.linalg.cholesky(products / np.multiply.outer(size, size)).T
    except np.linalg.LinAlgError:
        factor = np.zeros_like(products)
    if np.min(np.diag(factor)) < MIN_PIVOT:
        return np.asarray(np.linalg.qr(rows.T, mode="r"))
    return factor * size


def whitened(lines: Lines, poles: Complex[np.ndarray, " mode"]) -> Lines:
    """Lines multiplied by a level that makes their errors those of white noise."""
    fit = linear_fit(lines, poles)
    spread = error_spread(fit.errors, WIDE)
    spread = np.sqrt(np.mean(spread**2 / np.maximum(np.mean(spread**2, axis=0), 1e-300), axis=1))
    level = 1 / np.maximum(spread, MIN_SPREAD)
    return lines._replace(
        outputs=lines.outputs * level[:, None], inputs=lines.inputs * level[:, None], level=level
    )


def linear_fit(
    lines: Lines, poles: Complex[np.ndarray, " mode"], powers: tuple[int, ...] = REST_POWERS
) -> LinearFit:
    """Residues, transients and rest by least squares, for poles (1/s) and `powers` of z."""
    target = both_parts(lines.outputs)
    columns = both_parts(columns_of_model(lines, poles, powers))
    basis, factor = np.linalg.qr(columns)
    inside = basis.T @ target
    inverse_factor = np.linalg.pinv(factor)
    return LinearFit(
        columns, basis, inverse_factor, inverse_factor @ inside, target - basis @ inside
    )
