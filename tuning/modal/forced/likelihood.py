"""Modal model of responses to measured forces, refined by maximum likelihood.

Responses Y = sum_r R_r U / (i w - p_r) + x_r / (z - z_r) + conjugates + rest are linear in the
residues R_r and the transients x_r of the samples, z_r = exp(p_r T). Their errors are minimised
over the poles p_r by Gauss-Newton steps with the residues eliminated: the likelihood of output
errors of one variance for each output (El-Kafafy, De Troyer, Peeters and Guillaume 2013). Shapes
are the residues by least squares (LSFD), of rank one: shape times participation.

Errors of different lines of a spectrum are independent, and their variance changes little from line
to line. A lightly damped mode has few lines, which its residues follow, so that the errors left at
these have little information: at each line the variance is the mean over its neighbours, of errors
divided by what the model leaves free of them (leverage; MacKinnon and White 1985 for single
errors).
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int, Shaped
from scipy.ndimage import uniform_filter1d

from tuning.modal.forced.measured_responses import Lines

NEIGHBOURS = 5  # lines on either side from whose errors the variance of a line is estimated
BLOCKS = 48  # of lines, every 48th in one


class FreeErrors(NamedTuple):
    """Errors of rows (real parts of all lines, then imaginary), and one minus their leverage."""

    errors: Float[np.ndarray, "row output"]
    free: Float[np.ndarray, "row output"]


def line_means(
    rows: Float[np.ndarray, "row output"], reach: int
) -> Float[np.ndarray, "line output"]:
    """Mean over real and imaginary parts and `reach` lines on either side."""
    count = len(rows) // 2
    return uniform_filter1d(
        0.5 * (rows[:count] + rows[count:]), 2 * reach + 1, axis=0, mode="mirror"
    )


def free_errors(
    errors: Float[np.ndarray, "row output"],
    columns: Float[np.ndarray, "row column"],
    inverse: Float[np.ndarray, "column row"],
    slopes: Float[np.ndarray, "row part output"],
    normal: Float[np.ndarray, "part part"],
    weight: Float[np.ndarray, " output"],
) -> FreeErrors:
    """Errors of a fit with one minus their leverage.

    The leverage is that of the columns, linear for each output, and of the slopes by poles.
    """
    linear = np.einsum("rc,cr->r", columns, inverse)
    by_poles = np.einsum(
        "rko,kl,rlo,o->ro", slopes, np.linalg.pinv(normal, hermitian=True), slopes, weight,
        optimize=True,
    )  # fmt: skip
    return FreeErrors(errors, 1 - linear[:, None] - by_poles)


def replicates(found: FreeErrors) -> Iterator[tuple[Float[np.ndarray, "row output"], float]]:
    """Replicates of the errors, with their weights in a covariance.

    The errors of each neighbour in the place of a line, also turned by a quarter of a period.
    """
    count = len(found.errors) // 2
    complex_errors = found.errors[:count] + 1j * found.errors[count:]
    free = np.sqrt(np.maximum(line_means(found.free, NEIGHBOURS), 1e-3))
    places = np.arange(count)
    for shift in range(-NEIGHBOURS, NEIGHBOURS + 1):
        moved = complex_errors[_reflected(places + shift, count)] / free
        for turned in (moved, 1j * moved):
            yield np.concatenate([turned.real, turned.imag]), 0.5 / (2 * NEIGHBOURS + 1)


def degrees_of_freedom(found: FreeErrors, peak: int, width: float) -> float:
    """Free errors of one output about a peak `width` lines wide, of the output with fewest."""
    count = len(found.errors) // 2
    reach = NEIGHBOURS + int(width / 2)
    lines = slice(max(peak - reach, 0), peak + reach + 1)
    both = found.free[:count][lines] + found.free[count:][lines]
    return float(max(np.min(np.sum(both, axis=0)), 1.0))


def _reflected(places, count):
    places = np.abs(places)
    return np.where(places >= count, 2 * (count - 1) - places, places)


def columns_of_model(
    lines: Lines, poles: Complex[np.ndarray, " mode"], powers: tuple[int, ...]
) -> Complex[np.ndarray, "line column"]:
    """Columns of residues, transients and rest, for poles (1/s) and `powers` of z."""
    columns = _by_coefficients(lines, resonances_of(lines, poles), transients_of(lines, poles))
    signals = np.concatenate([lines.inputs, lines.unforced], axis=1)
    return np.concatenate([*columns, times_signals(_rest(lines, powers), signals)], axis=1)


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
    """Resonances 1 / (i w - p), and those of the conjugate poles (line, mode)."""
    s = 1j * np.angle(lines.z) / lines.step
    return (1 / (s - poles[:, None])).T, (1 / (s - poles.conj()[:, None])).T


def transients_of(
    lines: Lines, poles: Complex[np.ndarray, " mode"]
) -> tuple[Complex[np.ndarray, "line mode"], Complex[np.ndarray, "line mode"]]:
    """Transients 1 / (z - exp(p T)), and those of the conjugate poles (line, mode)."""
    roots = np.exp(poles * lines.step)
    return (1 / (lines.z - roots[:, None])).T, (1 / (lines.z - roots.conj()[:, None])).T


def times_signals(
    terms: Complex[np.ndarray, "line term"], signals: Shaped[np.ndarray, "line signal"]
) -> Complex[np.ndarray, "line column"]:
    """Products of all terms and signals, (line, term and signal); signals vary fastest."""
    return (terms.T[:, None, :] * signals.T[None, :, :]).reshape(-1, len(terms)).T


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


def columns_of_poles(
    lines: Lines, poles: Complex[np.ndarray, " mode"]
) -> Complex[np.ndarray, "line column"]:
    """Columns whose combinations are the derivatives of the responses by the poles.

    They are 1 / (i w - p)^2, and the same of the transients, times the signals.
    """
    step = lines.step
    factor = step * np.exp(poles * step)
    (own, other), (free, mirrored) = resonances_of(lines, poles), transients_of(lines, poles)
    transients = factor * free**2, factor.conj() * mirrored**2
    return np.concatenate(_by_coefficients(lines, (own**2, other**2), transients), axis=1)


def pole_directions(
    lines: Lines,
    found: Float[np.ndarray, "column output"],
    modes: int,
    moving: Int[np.ndarray, " moving"],
) -> Float[np.ndarray, "place part output"]:
    """Combinations (column, part, output) of the columns of the poles.

    They are derivatives of the responses by real, then imaginary parts of moving poles: with the
    real part a and the imaginary part b of a coefficient, and its two columns c and d, these are
    a c + b d, and a d - b c.
    """
    size, parts = moving.size, []
    for coefficients in split_coefficients(found, lines, modes):
        own = coefficients[moving]  # mode, signal, output
        spread = np.zeros((size, own.shape[1], size, own.shape[2]), complex)
        spread[np.arange(size), :, np.arange(size)] = own
        flat = spread.reshape(size * own.shape[1], size, own.shape[2])
        parts += [
            np.concatenate([flat.real, -flat.imag], axis=1),
            np.concatenate([flat.imag, flat.real], axis=1),
        ]
    return np.concatenate(parts)


REST_POWERS = (-2, -1, 0, 1, 2)  # of z, for modes above the band and those not found
FEWER_REST_POWERS = (0, 1)  # with which poles are compared
STEPS = 12  # of Gauss and Newton, at most
WIDE = 16  # lines on either side from whose errors the level of a line is estimated
MIN_SPREAD = 1e-3  # of errors, over that of all lines
# of Cholesky's factor, whose relative errors are those of rounding over its square
MIN_PIVOT = 1e-4
MAX_STEP = 0.5  # of a pole, over its width
CONVERGED = 1e-4  # step over the decay rate; what is left after it is of the order of its square
MAX_SHIFT = 3.0  # from the start, over the width; beyond, a pole is none of the data
MIN_WIDTH = 0.5  # of a pole, over the distance of lines: less has no effect on the lines


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
    """Modal model fitted to the lines of a band, with matrices for tests and uncertainties.

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

    Slopes by the poles are columns in some `directions`; `gram` has the products of their parts
    that residues cannot represent.
    """
    return np.einsum("cko,cd,dlo,o->kl", directions, gram, directions, weight, optimize=True)


def refined_poles(
    lines: Lines,
    starts: Complex[np.ndarray, " mode"],
    moving: Int[np.ndarray, " moving"],
    powers: tuple[int, ...] = REST_POWERS,
) -> Complex[np.ndarray, " mode"]:
    """Poles after Gauss-Newton steps; those that leave their surroundings return to the start."""
    poles = starts.astype(complex)
    least = MIN_WIDTH * lines.spacing
    for _ in range(STEPS if moving.size else 0):
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
    """Sums over all lines for a step of Gauss-Newton.

    These are the coefficients (column, output), the products of the columns of the moving poles
    after projection on the residues' complement, their products with the errors (column, output),
    and the sums of squared errors. All follow from the triangular factor of columns and outputs.
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
    of unit size differ from combinations of those before them by less than MIN_PIVOT: products lose
    that difference.
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
    power = line_means(fit.errors**2, WIDE)
    spread = np.sqrt(np.mean(power / np.maximum(np.mean(power, axis=0), 1e-300), axis=1))
    level = 1 / np.maximum(spread, MIN_SPREAD)
    return lines._replace(
        outputs=lines.outputs * level[:, None], inputs=lines.inputs * level[:, None], level=level
    )


def linear_fit(lines: Lines, poles: Complex[np.ndarray, " mode"]) -> LinearFit:
    """Residues, transients and rest by least squares, for poles (1/s)."""
    target = both_parts(lines.outputs)
    columns = both_parts(columns_of_model(lines, poles, REST_POWERS))
    basis, factor = np.linalg.qr(columns)
    inside = basis.T @ target
    inverse_factor = np.linalg.pinv(factor)
    return LinearFit(
        columns, basis, inverse_factor, inverse_factor @ inside, target - basis @ inside
    )
