"""What a fit leaves uncertain: covariance, intervals, and what the data cannot see."""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

UNIDENTIFIABLE_SD = (
    0.5  # standard error, in typical sizes, beyond which a direction counts as unseen
)
PARTICIPATION_SHARE = 0.1  # of an unseen direction: an address with more takes part in it
UNBOUNDED_SD = (
    1e4  # typical sizes: the spread of a direction without any effect is taken for so much
)
REPORTED_CHANGE = (
    0.1  # of a typical size: the largest change with which an unseen direction is reported
)


@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """Standard errors (infinite where the data cannot tell), correlation, unseen directions.

    Each unseen direction is a dictionary from address to change, in SI units: made together,
    these changes leave the readings as good as they are.
    """

    errors: Float[np.ndarray, " free"]
    correlation: Float[np.ndarray, "free free"]
    unidentifiable: list[dict[str, float]]


def autocorrelation_factor(residuals: Float[np.ndarray, " time"]) -> float:
    """Factor by which a residual's autocorrelation raises variances: 1 + 2 sum of correlations.

    Summed over the first lags, up to where the correlation vanishes in its own scatter; this is
    exact for slow changes of the reading and too much for fast ones (Box, Jenkins, Time Series
    Analysis, section 2.1.5).
    """
    if residuals.size < 2:
        return 1.0
    centred = residuals - residuals.mean()
    power = float(centred @ centred)
    if power == 0.0:
        return 1.0
    factor = 1.0
    limit = 1 / np.sqrt(centred.size)
    for lag in range(1, centred.size // 4):
        correlation = float(centred[:-lag] @ centred[lag:]) / power
        if correlation < limit:
            break
        factor += 2 * correlation
    return factor


def t_quantile(degrees_of_freedom: float) -> float:
    """Standard errors to either side of a 95 % interval: Student's quantile.

    `degrees_of_freedom` is the number of independent samples beyond those that the values took; 1.96 for many.
    """
    return float(student.ppf(0.975, degrees_of_freedom))


def uncertainty(
    addresses: list[str],
    jacobian: Float[np.ndarray, "residual free"],
    sizes: Float[np.ndarray, " free"],
) -> Uncertainty:
    """Uncertainty of values from the Jacobian of residuals in units of their standard errors.

    The covariance is the inverse of J' J, by the singular directions of J in typical `sizes`.
    Directions whose standard error exceeds `UNIDENTIFIABLE_SD` are unseen: all addresses that take part in
    one get names instead of numbers, and so does any whose own standard error exceeds it.
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
        (np.abs(directions) > PARTICIPATION_SHARE) | (deviations > UNIDENTIFIABLE_SD)
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
