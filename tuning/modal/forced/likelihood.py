"""Modal model of responses to measured forces, refined by maximum likelihood.

Responses Y = sum_r R_r U / (i w - p_r) + x_r / (z - z_r) + conjugates + rest are linear in the
residues R_r and the transients x_r of the samples, z_r = exp(p_r T). Their errors are minimised
over the poles p_r by Gauss-Newton steps with the residues eliminated: the likelihood of output
errors of one variance for each output (El-Kafafy, De Troyer, Peeters and Guillaume 2013). Shapes
are the residues by least squares (LSFD), of rank one: shape times participation.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int, Shaped

from tuning.modal.forced.common_denominator import Lines
from tuning.modal.forced.uncertainty import (
    FreeErrors,
    degrees_of_freedom,
    error_spread,
    free_errors,
)

REST_POWERS = (-2, -1, 0, 1, 2)  # of z, for modes above the band and those not found
FEWER_REST_POWERS = (0, 1)  # with which poles are compared
STEPS = 12
WIDE = 16  # lines on either side whose errors tell the level of a line
MIN_SPREAD = 1e-3  # of errors, over that of all lines
MAX_STEP = 0.5  # of a pole, over its decay rate
CONVERGED = 1e-4  # step over the decay rate; what is left after it is of the order of its square
MAX_SHIFT = 3.0  # from the start, over the decay rate; beyond, a pole is none of the data


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
    columns = _pole_columns(lines, poles[moving])
    inside, directions = fit.basis.T @ columns, _pole_directions(lines, fit, poles.size, moving)
    slopes = np.einsum("rc,cko->rko", columns - fit.basis @ inside, directions, optimize=True)
    by_poles = np.tensordot(fit.inverse_factor @ inside, directions, axes=1)
    weight, normal, _ = _normal_equations(fit, columns, directions)
    free = free_errors(fit.errors, fit.columns, fit.inverse, slopes, normal, weight)
    return FittedModel(
        plain, lines, poles, moving, fit, slopes, by_poles, weight, normal, free,
        np.concatenate([others.real, others.imag]),
    )  # fmt: skip


def _normal_equations(fit: LinearFit, columns, directions):
    """Weights of the outputs; matrix and right-hand side of the normal equations of the poles.

    Slopes by the poles are `columns` in some `directions`, less what residues make up for.
    """
    weight = 1 / np.maximum(np.mean(fit.errors**2, axis=0), 1e-300)
    inside = fit.basis.T @ columns
    gram = columns.T @ columns - inside.T @ inside
    matrix = np.einsum("cko,cd,dlo,o->kl", directions, gram, directions, weight, optimize=True)
    right = np.einsum("cko,co,o->k", directions, columns.T @ fit.errors, weight, optimize=True)
    return weight, matrix, right


def refined_poles(
    lines: Lines,
    starts: Complex[np.ndarray, " mode"],
    moving: Int[np.ndarray, " moving"],
    powers: tuple[int, ...] = REST_POWERS,
) -> Complex[np.ndarray, " mode"]:
    """Poles after Gauss-Newton steps; those that leave their surroundings return to the start."""
    poles = starts.astype(complex)
    for _ in range(STEPS if moving.size else 0):
        fit = linear_fit(lines, poles, powers)
        directions = _pole_directions(lines, fit, poles.size, moving)
        _, normal, right = _normal_equations(fit, _pole_columns(lines, poles[moving]), directions)
        step = np.linalg.lstsq(normal, right, rcond=1e-12)[0]
        change = step[: moving.size] + 1j * step[moving.size :]
        limit = MAX_STEP * np.abs(poles[moving].real)
        change *= np.minimum(1, limit / np.maximum(np.abs(change), 1e-300))
        poles[moving] += change
        far = np.abs(poles - starts) > MAX_SHIFT * np.abs(starts.real)
        lost = far | (poles.real >= 0)
        poles[lost] = starts[lost]
        if np.all(np.abs(change) < CONVERGED * np.abs(poles[moving].real)):
            break
    return poles


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
    columns = _columns(lines, poles, powers)
    basis, factor = np.linalg.qr(columns)
    inside = basis.T @ target
    inverse_factor = np.linalg.pinv(factor)
    return LinearFit(
        columns, basis, inverse_factor, inverse_factor @ inside, target - basis @ inside
    )


def _columns(lines: Lines, poles, powers):
    """Real parts above imaginary parts of the columns: residues, transients, rest."""
    columns = _by_coefficients(lines, resonances_of(lines, poles), transients_of(lines, poles))
    signals = np.concatenate([lines.inputs, lines.unforced], axis=1)
    return both_parts(np.concatenate([*columns, times_signals(_rest(lines, powers), signals)], 1))


def _by_coefficients(lines: Lines, resonances, transients):
    """Columns by real, then imaginary parts of residues, and likewise of transients."""
    columns = []
    for signals, first, second in ((lines.inputs, *resonances), (lines.unforced, *transients)):
        columns += [
            times_signals(first + second, signals),
            times_signals(1j * (first - second), signals),
        ]
    return columns


def _rest(lines: Lines, powers):
    """Terms (line, term) for modes outside of the band: above it powers of z, below it of 1 / w."""
    angles = np.angle(lines.z)
    below = 1j * angles / np.exp(np.mean(np.log(angles)))
    return np.concatenate([lines.z[:, None] ** np.array(powers), 1 / below[:, None] ** [1, 2]], 1)


def both_parts(values: Complex[np.ndarray, "line column"]) -> Float[np.ndarray, "row column"]:
    """Real parts above imaginary parts."""
    return np.concatenate([values.real, values.imag])


def resonances_of(
    lines: Lines, poles: Complex[np.ndarray, " mode"]
) -> tuple[Complex[np.ndarray, "line mode"], Complex[np.ndarray, "line mode"]]:
    """1 / (i w - p) and the same of the conjugate poles (line, mode)."""
    s = 1j * np.angle(lines.z)[:, None] / lines.step
    return 1 / (s - poles), 1 / (s - poles.conj())


def transients_of(
    lines: Lines, poles: Complex[np.ndarray, " mode"]
) -> tuple[Complex[np.ndarray, "line mode"], Complex[np.ndarray, "line mode"]]:
    """1 / (z - exp(p T)) and the same of the conjugate poles (line, mode)."""
    roots = np.exp(poles * lines.step)
    return 1 / (lines.z[:, None] - roots), 1 / (lines.z[:, None] - roots.conj())


def times_signals(
    terms: Complex[np.ndarray, "line term"], signals: Shaped[np.ndarray, "line signal"]
) -> Complex[np.ndarray, "line column"]:
    """Products of all terms and signals, the signals of a term side by side."""
    return (terms[:, :, None] * signals[:, None, :]).reshape(len(terms), -1)


def coefficient_places(lines: Lines, modes: int, k: int) -> Int[np.ndarray, " place"]:
    """Rows of the coefficients that are those of the k-th of some modes, forced and free."""
    places, first = [], 0
    for signals in (lines.inputs.shape[1], lines.unforced.shape[1]):
        for _ in range(2):  # real parts, imaginary parts
            places.append(first + k * signals + np.arange(signals))
            first += modes * signals
    return np.concatenate(places)


def split_coefficients(
    found: Float[np.ndarray, "column output"], lines: Lines, modes: int
) -> list[Complex[np.ndarray, "mode signal output"]]:
    """Complex residues (mode, input, output) and transients (mode, record, output)."""
    parts, first = [], 0
    for signals in (lines.inputs.shape[1], lines.unforced.shape[1]):
        half = modes * signals
        both = found[first : first + half] + 1j * found[first + half : first + 2 * half]
        parts.append(both.reshape(modes, signals, both.shape[1]))
        first += 2 * half
    return parts


def _pole_columns(lines: Lines, poles) -> Float[np.ndarray, "row column"]:
    """Columns whose combinations are the derivatives of the responses by the poles.

    They are 1 / (i w - p)^2, and the same of the transients, times the signals.
    """
    step = lines.step
    factor = step * np.exp(poles * step)
    (own, other), (free, mirrored) = resonances_of(lines, poles), transients_of(lines, poles)
    transients = factor * free**2, factor.conj() * mirrored**2
    return both_parts(
        np.concatenate(_by_coefficients(lines, (own**2, other**2), transients), axis=1)
    )


def _pole_directions(lines: Lines, fit: LinearFit, modes: int, moving):
    """Combinations (column, part, output) of the columns of the poles.

    They are derivatives of the responses by real, then imaginary parts of moving poles: with the
    real part a and the imaginary part b of a coefficient, and its two columns c and d, these are
    a c + b d, and a d - b c.
    """
    size, parts = moving.size, []
    for coefficients in split_coefficients(fit.found, lines, modes):
        own = coefficients[moving]  # mode, signal, output
        spread = np.zeros((size, own.shape[1], size, own.shape[2]), complex)
        spread[np.arange(size), :, np.arange(size)] = own
        flat = spread.reshape(size * own.shape[1], size, own.shape[2])
        parts += [
            np.concatenate([flat.real, -flat.imag], axis=1),
            np.concatenate([flat.imag, flat.real], axis=1),
        ]
    return np.concatenate(parts)
