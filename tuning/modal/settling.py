"""Start of a log while sensors settle: AC-coupled ones saturate when they are switched on."""

import numpy as np
from jaxtyping import Float

MIN_STUCK_SAMPLES = 12  # equal samples at the start of a channel that is saturated
MAX_SHARE = 0.5  # of a record that is left out


def settled_from(values: Float[np.ndarray, "time channel"]) -> int:
    """First sample from which all channels have settled; 0 if none starts at one stuck value.

    Of a channel that starts stuck, the samples left out are those that make the standard error of
    the mean of the others least (White, An effective truncation heuristic for bias reduction in
    simulation output, 1997), half of them at most.
    """
    starts = [_settled(column) for column in values.T if _is_stuck(column)]
    return max(starts, default=0)


def _is_stuck(column) -> bool:
    first = column[:MIN_STUCK_SAMPLES]
    return column.size > 2 * MIN_STUCK_SAMPLES and bool(
        np.all(first == first[0]) and np.ptp(column)
    )


def _settled(column) -> int:
    """Truncation d with the least sum of squared deviations of x[d:] over (n - d)^2."""
    backwards = column[::-1] - np.median(column)
    count = np.arange(1, column.size + 1)
    squares = np.cumsum(backwards**2) - np.cumsum(backwards) ** 2 / count
    left_out = column.size - count
    error = np.where(left_out <= MAX_SHARE * column.size, squares / count**2, np.inf)
    return int(left_out[np.argmin(error)])
