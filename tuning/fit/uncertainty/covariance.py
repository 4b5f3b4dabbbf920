"""Covariance, confidence intervals and unidentifiable directions of a least-squares fit.

All follow from the singular values of the fit's Jacobian.
"""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

# All but LEAST_PARTICIPATION are in typical sizes of the parameters.
UNIDENTIFIABLE_SD = 0.5  # standard error beyond which a direction counts as unidentifiable
LEAST_PARTICIPATION = 0.1  # component of a unit direction above which an address is part of it
UNBOUNDED_SD = 1e4  # standard error given to a direction without any effect
REPORTED_CHANGE = 0.1  # largest change with which an unidentifiable direction is reported


@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """Standard errors, correlation and unidentifiable directions, in the order of the addresses.

    Errors (SI) are infinite, and correlations NaN, where a parameter is not identifiable. Each
    entry of `unidentifiable` is a dictionary from address to change (SI): made together, these
    changes leave the readings as good as they are.
    """

    errors: Float[np.ndarray, " parameter"]
    correlation: Float[np.ndarray, "parameter parameter"]
    unidentifiable: list[dict[str, float]]


def autocorrelation(centred: Float[np.ndarray, " time"], lag: int) -> float:
    """Autocorrelation, at a lag of so many samples, of a series whose mean is zero."""
    return float(centred[:-lag] @ centred[lag:]) / float(centred @ centred)


def autocorrelation_factor(residuals: Float[np.ndarray, " time"]) -> float:
    """Factor by which a residual's autocorrelation raises variances: 1 + 2 sum of correlations.

    Summed over the first lags, up to where the correlation falls below its own scatter,
    1 / sqrt(n). Exact for slow changes of the reading, too large for fast ones (Box and Jenkins,
    Time Series Analysis, section 2.1.5).
    """
    if residuals.size < 2:
        return 1.0
    centred = residuals - residuals.mean()
    if float(centred @ centred) == 0.0:
        return 1.0
    factor = 1.0
    limit = 1 / np.sqrt(centred.size)
    for lag in range(1, centred.size // 4):
        correlation = autocorrelation(centred, lag)
        if correlation < limit:
            break
        factor += 2 * correlation
    return factor


def t_quantile(degrees_of_freedom: float) -> float:
    """Half width of a 95 % interval in standard errors: Student's quantile, 1.96 in the limit.

    `degrees_of_freedom` is the number of independent samples less that of the parameters.
    """
    return float(student.ppf(0.975, degrees_of_freedom))


def confidence_intervals(
    values: Float[np.ndarray, " parameter"],
    errors: Float[np.ndarray, " parameter"],
    degrees_of_freedom: float,
) -> Float[np.ndarray, "parameter 2"]:
    """95 % intervals of values with their standard errors; infinite for infinite errors."""
    half = t_quantile(degrees_of_freedom) * errors
    return np.stack([values - half, values + half], axis=1)


def uncertainty(
    addresses: list[str],
    jacobian: Float[np.ndarray, "residual parameter"],
    sizes: Float[np.ndarray, " parameter"],
) -> Uncertainty:
    """Uncertainty of values from the Jacobian of residuals in units of their standard deviation.

    The covariance is the inverse of J' J, by the singular directions of J in typical `sizes`.
    Directions whose standard error exceeds `UNIDENTIFIABLE_SD` are unidentifiable: addresses that
    are part of one are named and have no standard error, and so have all whose own exceeds it.
    """
    _, strength, directions = np.linalg.svd(np.linalg.qr(jacobian * sizes, mode="r"))
    # Columns in exact proportion leave a strength of rounding size.
    spread = np.full(len(addresses), UNBOUNDED_SD)
    strong = strength > strength.max(initial=0.0) * 1e-9
    spread[: strength.size][strong] = np.minimum(1 / strength[strong], UNBOUNDED_SD)
    deviations = np.abs(directions) * spread[:, None]
    errors = np.sqrt(np.sum(deviations**2, axis=0))
    covariance = (directions.T * spread**2) @ directions
    correlation = covariance / np.outer(errors, errors)
    unidentifiable = spread > UNIDENTIFIABLE_SD
    participates = unidentifiable[:, None] & (
        (np.abs(directions) > LEAST_PARTICIPATION) | (deviations > UNIDENTIFIABLE_SD)
    )
    without_error = participates.any(axis=0) | (errors > UNIDENTIFIABLE_SD)
    changes = []
    for direction, takes_part in zip(
        directions[unidentifiable], participates[unidentifiable], strict=True
    ):
        change = direction * sizes * REPORTED_CHANGE / direction[np.abs(direction).argmax()]
        changes.append({addresses[i]: float(change[i]) for i in np.flatnonzero(takes_part)})
    return Uncertainty(
        np.where(without_error, np.inf, errors * sizes),
        np.where(without_error[:, None] | without_error[None, :], np.nan, correlation),
        changes,
    )
