"""What a fit leaves uncertain: covariance, intervals, and what the data cannot see."""

import dataclasses

import numpy as np
from jaxtyping import Float

BLIND = 0.5  # standard error, in typical sizes, beyond which a direction counts as unseen
SHARE = 0.1  # of an unseen direction: addresses with less are taken to be seen
INTERVAL = 1.959964  # standard errors to either side: 95 % of a normal distribution


@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """Standard errors (infinite where the data see nothing), correlation, unseen directions.

    Each unseen direction is a dictionary from address to relative share, in typical sizes.
    """

    errors: Float[np.ndarray, " free"]
    correlation: Float[np.ndarray, "free free"]
    unseen: list[dict[str, float]]


def colour(residuals: Float[np.ndarray, " time"]) -> float:
    """Factor by which a residual's autocorrelation raises variances: 1 + 2 sum of correlations.

    Summed over the first lags up to where the correlation vanishes in its own scatter.
    """
    centred = residuals - residuals.mean()
    power = float(centred @ centred)
    if power == 0.0:
        return 1.0
    factor = 1.0
    limit = 2 / np.sqrt(centred.size)
    for lag in range(1, centred.size // 4):
        correlation = float(centred[:-lag] @ centred[lag:]) / power
        if correlation < limit:
            break
        factor += 2 * correlation
    return factor


def uncertainty(
    addresses: list[str],
    jacobian: Float[np.ndarray, "residual free"],
    sizes: Float[np.ndarray, " free"],
) -> Uncertainty:
    """Uncertainty of values from the Jacobian of residuals in units of their standard errors.

    Singular directions of the Jacobian in typical `sizes` whose standard error exceeds `BLIND`
    are unseen: they get names instead of numbers, and so do all addresses that take part in one.
    """
    scaled = jacobian * sizes
    _, strength, directions = np.linalg.svd(scaled, full_matrices=False)
    with np.errstate(divide="ignore"):
        spread = 1 / strength
    # Columns in exact proportion leave a strength of rounding size.
    blind = (spread > BLIND) | (strength < strength.max(initial=0.0) * 1e-9)
    seen = directions[~blind]
    covariance = (seen.T * spread[~blind] ** 2) @ seen
    errors = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / np.outer(errors, errors)
    touched = np.any(np.abs(directions[blind]) > SHARE, axis=0)
    errors = np.where(touched, np.inf, errors * sizes)
    correlation = np.where(touched[:, None] | touched[None, :], np.nan, correlation)
    unseen = []
    for direction in directions[blind]:
        lead = direction[np.abs(direction).argmax()]
        shares = {
            address: float(share / lead)
            for address, share in zip(addresses, direction, strict=True)
            if abs(share) > SHARE
        }
        unseen.append(shares)
    return Uncertainty(errors, correlation, unseen)
