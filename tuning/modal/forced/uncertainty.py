"""Uncertainty of a modal model from the errors of its lines.

Errors of different lines of a spectrum are independent, and their variance changes little from line
to line. A lightly damped mode has few lines, which its residues follow, so that the errors left at
these tell little: at each line the variance is the mean over its neighbours, of errors divided by
what the model leaves free of them (leverage; MacKinnon and White 1985 for single errors).
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

NEIGHBOURS = 5  # lines on either side whose errors tell the variance of a line
BLOCKS = 48  # of lines, every 48th in one


class FreeErrors(NamedTuple):
    """Errors of rows (real parts of all lines, then imaginary), and shares that were free."""

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


def error_spread(
    errors: Float[np.ndarray, "row output"], reach: int
) -> Float[np.ndarray, "line output"]:
    """Root mean square of errors over `reach` lines on either side of each."""
    return np.sqrt(line_means(errors**2, reach))


def free_errors(
    errors: Float[np.ndarray, "row output"],
    columns: Float[np.ndarray, "row column"],
    inverse: Float[np.ndarray, "column row"],
    slopes: Float[np.ndarray, "row part output"],
    normal: Float[np.ndarray, "part part"],
    weight: Float[np.ndarray, " output"],
) -> FreeErrors:
    """Errors with one minus their leverage.

    The leverage is that of the columns, linear for each output, and of the slopes by poles.
    """
    linear = np.einsum("rc,cr->r", columns, inverse)
    by_poles = np.einsum(
        "rko,kl,rlo,o->ro", slopes, np.linalg.pinv(normal, hermitian=True), slopes, weight,
        optimize=True,
    )  # fmt: skip
    return FreeErrors(errors, 1 - linear[:, None] - by_poles)


def replicates(found: FreeErrors) -> Iterator[tuple[Float[np.ndarray, "row output"], float]]:
    """Errors that could have been, with their weights in a covariance.

    Those of each neighbour in the place of a line, also turned by a quarter of a period.
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
