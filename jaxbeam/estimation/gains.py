"""Gains of time-invariant estimators: Kalman filters and pole placement."""

from jaxtyping import Float

from jaxbeam.numerics.discretisation import balance
from jaxbeam.numerics.riccati import care, dare
from jaxbeam.runtime.arrays import Array, solve, xp

Square = Float[Array, "state state"]
Rows = Float[Array, "output state"]
Outputs = Float[Array, "output output"]
Gain = tuple[Float[Array, "state output"], Square]


def kalman_gain(A: Square, C: Rows, Q: Square, R: Outputs) -> Gain:
    """Gain L of the filter x' = A x + B u + L (y - C x) in continuous time, and its covariance P.

    Q and R are the intensities of the white noise of x' and of y. Eqs (4.5) and (4.6) of the
    thesis, corrected: L = P C' R^-1, A P + P A' - P C' R^-1 C P + Q = 0. Differentiable. Raises
    ValueError as `riccati.care` does.
    """
    covariance = care(A.T, C.T, Q, R)
    return solve(R, C @ covariance).T, covariance


def sampled_kalman_gain(A: Square, C: Rows, Q: Square, R: Outputs) -> Gain:
    """Gain K of the sampled filter, which adds K (y - C x) to a prediction x, and its covariance.

    x_(k+1) = A x_k + B u_k + w, y = C x + v with covariances Q of w and R of v. The covariance is
    that of the prediction. Differentiable. Raises ValueError as `riccati.dare` does.
    """
    covariance = dare(A.T, C.T, Q, R)
    return filter_gain(covariance, C, R), covariance


def filter_gain(covariance: Square, C: Rows, R: Outputs) -> Float[Array, "state output"]:
    """Gain K = P C' (C P C' + R)^-1 for a prediction of covariance P."""
    return solve(C @ covariance @ C.T + R, C @ covariance).T


def placed_gain(A: Square, C: Rows, desired: Square) -> Float[Array, "state output"]:
    """L with which A - L C has the eigenvalues of the matrix `desired`; differentiable.

    From A'X - X desired = C'C and L' = C X^-1 (Bhattacharyya and de Souza, Systems & Control
    Letters 1, 1982). A and `desired` must have no common eigenvalue, and both be observable through
    C; otherwise the result is NaN or meaningless.
    """
    scale = balance(A)
    A, desired = A * scale / scale[:, None], desired * scale / scale[:, None]
    rows = C * scale
    row_norms = xp.sqrt(xp.sum(rows**2, axis=1))
    rows = rows / row_norms[:, None]
    identity = xp.eye(A.shape[0])
    sylvester = xp.kron(A.T, identity) - xp.kron(identity, desired.T)
    X = solve(sylvester, (rows.T @ rows).reshape(-1)).reshape(A.shape)
    return scale[:, None] * solve(X.T, rows.T) / row_norms
