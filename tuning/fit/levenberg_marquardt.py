"""The Levenberg-Marquardt method for residuals and derivatives that come together."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

ACCEPTED_SHARE = 0.01  # of the predicted decrease, from which a step is accepted
GOOD_SHARE = 0.99  # of the predicted decrease, above which the next step is damped less
# Of the sum of squares, a predicted decrease too small to be told from rounding of the residuals.
NEGLIGIBLE_SHARE = 1e-11
LESS_DAMPING, MORE_DAMPING = 1 / 3.5, 4.0  # factors of the damping after good and rejected steps


class Minimum(NamedTuple):
    """Point at which a search ended, and whether it converged there."""

    point: Float[np.ndarray, " variable"]
    converged: bool


def levenberg_marquardt(
    linearised: Callable,
    start: Float[np.ndarray, " variable"],
    rtol: float,
    atol: float,
    max_steps: int,
) -> Minimum:
    """Minimum of half the sum of squared residuals, from a start.

    `linearised` maps a point to residuals (residual,) and their derivatives (residual, variable).
    A step d minimises |r + J d|^2 + damping |d|^2, the damping is 1 at first; with a trust region
    as Gould et al. (4OR 3, 2005) chose it for it. Converged once an accepted step changes no
    variable and no residual by more than atol + rtol times its size, or the next promises a
    decrease by less than a share of NEGLIGIBLE_SHARE. Points at which residuals are not finite are
    rejected.
    """
    point, damping = start, 1.0
    residuals, jacobian = linearised(start)
    # Of residuals and derivatives only their products matter: those of the triangular factor.
    factor = _factor(residuals, jacobian)
    for _ in range(max_steps - 1):
        if not np.all(np.isfinite(factor)):
            break
        change = _damped_step(factor, damping)
        predicted = (np.sum((factor @ np.append(change, 1.0)) ** 2) - _squares(factor)) / 2
        if damping <= 1 and -predicted <= NEGLIGIBLE_SHARE * _squares(factor):
            return Minimum(point, True)
        trial_residuals, jacobian = linearised(point + change)
        trial_factor = _factor(trial_residuals, jacobian)
        decrease = (_squares(trial_factor) - _squares(factor)) / 2
        if not decrease <= ACCEPTED_SHARE * predicted:
            damping *= MORE_DAMPING
            continue
        if decrease < GOOD_SHARE * predicted and predicted < 0:
            damping *= LESS_DAMPING
        point, factor = point + change, trial_factor
        moved = np.abs(change) / (atol + rtol * np.abs(point))
        changed = np.abs(trial_residuals - residuals) / (atol + rtol * np.abs(trial_residuals))
        if max(moved.max(), changed.max()) < 1:
            return Minimum(point, True)
        residuals = trial_residuals
    return Minimum(point, False)


def _factor(residuals, jacobian):
    """Triangular factor of derivatives and residuals side by side; not finite if they are not."""
    both = np.column_stack([jacobian, residuals])
    if not np.all(np.isfinite(both)):
        return np.full((both.shape[1],) * 2, np.nan)
    return np.linalg.qr(both, mode="r")


def _squares(factor) -> float:
    """Sum of squared residuals."""
    return float(np.sum(factor[:, -1] ** 2))


def _damped_step(factor, damping):
    """Step that minimises |r + J d|^2 + damping |d|^2."""
    size = factor.shape[1] - 1
    matrix = np.vstack([factor[:, :-1], np.sqrt(damping) * np.eye(size)])
    return np.linalg.lstsq(matrix, np.append(-factor[:, -1], np.zeros(size)), rcond=None)[0]
