"""Tests of a modal model: poles that chance explains, and missing poles.

A pole placed at a chance peak of the noise fits it well, so that its errors say nothing against
it; but what it explains, at one of many lines, is not more than the noise makes it. A pole that is
missing leaves errors along 1 / (s - p). These are tests of F.
"""

import numpy as np
from jaxtyping import Float
from scipy.stats import f as fisher

from tuning.modal.forced.likelihood import (
    NEIGHBOURS,
    FittedModel,
    LinearFit,
    both_parts,
    coefficient_places,
    line_means,
    resonances_of,
    times_signals,
    transients_of,
)
from tuning.modal.forced.measured_responses import Lines

DAMPING_RATIOS = (0.004, 0.016, 0.064)  # of poles that are tried
NEAR_LINES, NEAR_WIDTHS = 32, 16.0  # about a pole that is tried: lines, and decay rates
MIN_SIZE = 1e-12  # of the largest; directions below it were left out of the fit
MOST_PROMISING = 3  # of them, whose probabilities are computed


def mode_chances(model: FittedModel) -> Float[np.ndarray, " mode"]:
    """Probability that noise explains the response of each mode, forced and free.

    Both together, as the response to an impact at the start of a record is like a free one.
    """
    outputs, found = model.fit.errors.shape[1], []
    variance = _local_variance(model.fit.errors, model.free.free)
    for k in range(model.poles.size):
        # Without its coefficients x the sum of squared errors is more by x^T (F F^T)^-1 x. After a
        # impact at the start forced and free ones are nearly one: F F^T would lose their sum.
        own = coefficient_places(model.lines, model.poles.size, k)
        directions, sizes, _ = np.linalg.svd(model.fit.inverse_factor[own], full_matrices=False)
        kept = sizes > MIN_SIZE * sizes[0]
        along = directions.T[kept] @ model.fit.found[own] / sizes[kept, None]
        gains = np.sum(along**2, axis=0)
        count = own.size * outputs
        statistic = np.sum(gains / variance[model.peak(k)]) / count
        chance = fisher.sf(statistic, count, model.freedom(k) * outputs)
        found.append(len(model.lines.z) * chance)
    return np.array(found)


def missing_pole(model: FittedModel, band: tuple[float, float]) -> tuple[complex, float]:
    """The pole (1/s) that would lower the errors most, and the probability that noise does so."""
    tried = promising_poles(model.lines, model.fit.errors, band)
    best = tried[:MOST_PROMISING]
    chances = [_chance(model, pole) for pole in best]
    least = int(np.argmin(chances))
    return best[least], len(tried) * chances[least]


def promising_poles(
    lines: Lines, errors: Float[np.ndarray, "row output"], band: tuple[float, float]
) -> list[complex]:
    """Poles (1/s) in a band (Hz), those first that seem to explain most of the errors.

    They are of several damping ratios, a half-power bandwidth apart.
    """
    low, high = 2 * np.pi * band[0], 2 * np.pi * band[1]
    tried = [
        -ratio * angular + 1j * angular
        for ratio in DAMPING_RATIOS
        for angular in np.geomspace(low, high, int(np.log(high / low) / (2 * ratio)) + 2).tolist()
    ]
    # Without the terms of the model in them, columns explain less than they could: a first choice.
    least = _least_statistics(lines, errors, tried)
    return [tried[k] for k in np.argsort(-least, kind="stable")]


def _least_statistics(lines: Lines, errors, tried) -> Float[np.ndarray, " tried"]:
    """Reduction of the errors by a pole 1 / (s - p), over their variance, the model unchanged."""
    angular = np.angle(lines.z) / lines.step
    variance = line_means(errors**2, NEIGHBOURS)
    errors = errors.reshape(2, len(lines.z), -1)
    reach = NEAR_LINES * lines.spacing
    found = []
    for pole in tried:
        near = np.abs(angular - pole.imag) < reach + NEAR_WIDTHS * abs(pole.real)
        columns = _columns_of(lines.part(near), pole)
        along = np.linalg.qr(columns)[0].T @ errors[:, near].reshape(len(columns), -1)
        own = variance[np.argmin(np.abs(angular - pole.imag))]
        found.append(np.sum(np.sum(along**2, axis=0) / np.maximum(own, 1e-300)))
    return np.array(found)


def _columns_of(lines: Lines, pole):
    """Columns (row, column) of 1 / (s - p), forced and free."""
    parts = []
    for signals, (first, second) in (
        (lines.inputs, resonances_of(lines, np.array([pole]))),
        (lines.unforced, transients_of(lines, np.array([pole]))),
    ):
        parts += [times_signals(first + second, signals)]
        parts += [times_signals(1j * (first - second), signals)]
    return both_parts(np.concatenate(parts, axis=1))


def _chance(model: FittedModel, pole: complex) -> float:
    """Probability that a pole 1 / (s - p) reduces the errors as much by noise alone."""
    fit, columns = model.fit, _columns_of(model.lines, pole)
    basis = np.linalg.qr(columns - fit.basis @ (fit.basis.T @ columns))[0]
    along = basis.T @ fit.errors
    variance = _without(model, basis, along, model.peak_at(pole))
    statistic = np.sum(np.sum(along**2, axis=0) / variance) / along.size
    freedom = max(model.freedom_at(pole) - basis.shape[1], 1.0) * fit.errors.shape[1]
    return float(fisher.sf(statistic, along.size, freedom))


def _without(model: FittedModel, basis, along, peak):
    """Variance of each output about a line, without the errors along a basis."""
    count = len(model.lines.z)
    lines = np.arange(max(peak - NEIGHBOURS, 0), min(peak + NEIGHBOURS + 1, count))
    rows = np.concatenate([lines, count + lines])
    errors = model.fit.errors[rows] - basis[rows] @ along
    free = model.free.free[rows] - np.sum(basis[rows] ** 2, axis=1)[:, None]
    return np.sum(errors**2, axis=0) / np.maximum(np.sum(free, axis=0), 1e-3 * rows.size)


def criterion(fit: LinearFit, modes: int) -> float:
    """Bayesian information criterion (Schwarz 1978) of a fit to lines with errors of one level.

    It is less for the better model.
    """
    (rows, columns), squares = fit.columns.shape, np.sum(fit.errors**2, axis=0)
    parameters = squares.size * columns + 2 * modes
    size = np.sum(np.log(np.maximum(squares / rows, 1e-300)))
    return float(rows * size + parameters * np.log(rows))


def _local_variance(errors, free):
    """Variance of a real or imaginary part at each line (line, output), by its neighbours."""
    power, freedom = (line_means(one, NEIGHBOURS) for one in (errors**2, free))
    return power / np.maximum(freedom, 1e-3)
