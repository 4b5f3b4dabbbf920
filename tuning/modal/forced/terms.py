"""Terms of the modal model of responses to measured forces: columns of its linear least squares.

Of complex columns each is one stretch of memory, so that real and imaginary parts are at hand.
"""

import numpy as np
from jaxtyping import Complex, Float, Int, Shaped

from tuning.modal.forced.common_denominator import Lines


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
    """1 / (i w - p) and the same of the conjugate poles (line, mode)."""
    s = 1j * np.angle(lines.z) / lines.step
    return (1 / (s - poles[:, None])).T, (1 / (s - poles.conj()[:, None])).T


def transients_of(
    lines: Lines, poles: Complex[np.ndarray, " mode"]
) -> tuple[Complex[np.ndarray, "line mode"], Complex[np.ndarray, "line mode"]]:
    """1 / (z - exp(p T)) and the same of the conjugate poles (line, mode)."""
    roots = np.exp(poles * lines.step)
    return (1 / (lines.z - roots[:, None])).T, (1 / (lines.z - roots.conj()[:, None])).T


def times_signals(
    terms: Complex[np.ndarray, "line term"], signals: Shaped[np.ndarray, "line signal"]
) -> Complex[np.ndarray, "line column"]:
    """Products of all terms and signals, the signals of a term side by side."""
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
