"""Losses of a fit: squares, and robust ones that reduce the weight of outliers.

Each loss is half the square of `robust_residual(r)`, so that least squares minimises any of them;
r is a residual over the standard deviation of the noise.
"""

import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import Array, xp

LOSSES = ("squares", "soft-l1", "huber")
HUBER_THRESHOLD = 1.345  # 95 % of the efficiency of squares for normal noise


def check_loss(loss: str) -> None:
    """Raises ValueError for an unknown loss."""
    if loss not in LOSSES:
        raise ValueError(f"a loss is one of {', '.join(LOSSES)}, not {loss!r}")


def robust_residual(loss: str, residual: Float[Array, "*any"]) -> Float[Array, "*any"]:
    """Residual f whose half square f^2 / 2 is the loss.

    soft-l1: f^2 / 2 = sqrt(1 + r^2) - 1; Huber: f^2 / 2 = k |r| - k^2 / 2 beyond k.
    """
    if loss == "soft-l1":
        return residual * xp.sqrt(2 / (1 + xp.sqrt(1 + residual**2)))
    if loss == "huber":
        clipped = xp.maximum(xp.abs(residual), HUBER_THRESHOLD)
        return xp.where(
            xp.abs(residual) <= HUBER_THRESHOLD,
            residual,
            xp.sign(residual) * xp.sqrt(2 * HUBER_THRESHOLD * clipped - HUBER_THRESHOLD**2),
        )
    return residual


def robust_slope(loss: str, residual: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Derivative of `robust_residual` of known residuals.

    That of the loss over f: r / sqrt(1 + r^2) for soft-l1, k sign(r) beyond k for Huber.
    """
    size = np.abs(robust_residual(loss, residual))
    with np.errstate(invalid="ignore", divide="ignore"):
        if loss == "soft-l1":
            return np.where(size > 0, np.abs(residual) / np.sqrt(1 + residual**2) / size, 1.0)
        if loss == "huber":
            return np.where(np.abs(residual) > HUBER_THRESHOLD, HUBER_THRESHOLD / size, 1.0)
    return np.ones_like(residual)


def variance_factor(loss: str, residuals: Float[np.ndarray, " sample"]) -> float:
    """Factor by which variances of a robust fit exceed those of linearised least squares.

    E[psi^2] / E[psi']^2 with psi the derivative of the loss (Huber, Robust Statistics, section
    6.3), for residuals over the standard deviation of the noise.
    """
    if loss == "soft-l1":
        root = np.sqrt(1 + residuals**2)
        influence, stiffness = residuals / root, 1 / root**3
    elif loss == "huber":
        influence = np.clip(residuals, -HUBER_THRESHOLD, HUBER_THRESHOLD)
        stiffness = np.abs(residuals) <= HUBER_THRESHOLD
    else:
        return 1.0
    return float(np.mean(influence**2) / np.mean(stiffness) ** 2)
