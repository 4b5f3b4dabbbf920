"""Riccati equations in continuous and discrete time, Lyapunov and Stein equations by doubling.

Riccati equations are solved by the structured doubling algorithm (Chu, Fan, Lin and Wang,
Int. J. Control 77, 2004) and refined by Newton's method (Kleinman, IEEE Trans. Automatic Control
13, 1968). Neither needs eigenvalues, so they run on every device, in batches; derivatives are
implicit, forward and reverse.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.numerics.matrices import InputMatrix, InputWeight, Square, symmetric_part
from jaxbeam.numerics.stages import balance
from jaxbeam.runtime.arrays import Array, any_jax, custom_jvp, solve, stop_gradient, while_loop, xp

MAX_DOUBLINGS = 60  # after which an equation is taken for unsolvable
TRANSITION_TOLERANCE = 1e-9  # norm of a transition matrix whose square is below rounding


def lyapunov(A: Square, S: Square) -> Square:
    """Solution X of A'X + X A + S = 0 for a stable A; nan for another."""

    def sum_of_series(matrix, right):
        shift, identity = cayley_shift(matrix), xp.eye(matrix.shape[0])
        inverse = solve(shift * identity - matrix, identity)
        discrete_matrix = inverse @ (shift * identity + matrix)
        return _stein_series(discrete_matrix, 2 * shift * inverse.T @ right @ inverse)

    return _solve_balanced(A, S, lambda A, X: -(A.T @ X + X @ A), sum_of_series)


def stein(A: Square, S: Square) -> Square:
    """Solution X of A'X A - X + S = 0 for eigenvalues of A in the unit circle, else nan."""
    return _solve_balanced(A, S, lambda A, X: X - A.T @ X @ A, _stein_series)


def cayley_shift(matrix: Square) -> Float[Array, ""]:
    """Centre of Cayley's transform: a rate above that of any eigenvalue."""
    return 1.1 * xp.max(xp.sum(xp.abs(matrix), axis=1)) + xp.finfo(float).tiny


def _solve_balanced(A: Square, S: Square, operator: Callable, solution: Callable) -> Square:
    """Solution X of operator(A, X) = S, linear in X, by `solution` for the balanced A."""
    scale = balance(A)
    scaled = A * scale / scale[:, None]
    outer = scale * scale[:, None]
    if not any_jax(scaled, S):
        return solution(scaled, S * outer) / outer
    scaled_solution = jax.lax.custom_linear_solve(
        lambda X: operator(scaled, X),
        S * outer,
        lambda _, right: solution(scaled, right),
        lambda _, right: solution(scaled.T, right),
    )
    return scaled_solution / outer


def _stein_series(A, first_term):
    """Sum over k of A'^k first_term A^k, with the number of terms doubled each time."""

    def unconverged(state):
        _, power, count = state
        return (xp.max(xp.abs(power)) > TRANSITION_TOLERANCE) & (count < MAX_DOUBLINGS)

    def double(state):
        total, power, count = state
        return total + power.T @ total @ power, power @ power, count + 1

    total, power, _ = while_loop(unconverged, double, (first_term, A, 0))
    return xp.where(xp.max(xp.abs(power)) <= TRANSITION_TOLERANCE, total, xp.nan)


GainAndCost = tuple[Float[Array, "input state"], Square]


class Interval(NamedTuple):
    """Transition matrix Phi, G and H of an interval of optimal control.

    The optimal state x and costate l = P x obey x1 = Phi x0 - G l1 and l0 = H x0 + Phi' l1, with
    symmetric, positive semidefinite G and H.
    """

    transition: Square
    G: Square
    H: Square

    def compose(self, later: "Interval") -> "Interval":
        """This interval followed by a later one; associative, and stable for stiff plants."""
        coupling = xp.eye(self.transition.shape[0]) + self.G @ later.H
        solved = solve(coupling, xp.concatenate([self.transition, self.G], axis=1))
        transition, G = xp.split(solved, 2, axis=1)
        return Interval(
            transition=later.transition @ transition,
            G=later.G + symmetric_part(later.transition @ G @ later.transition.T),
            H=self.H + symmetric_part(self.transition.T @ later.H @ transition),
        )


def care(
    A: Square, B: InputMatrix, Q: Square, R: InputWeight, N: InputMatrix | None = None
) -> Square:
    """Stabilising P of A'P + P A - (P B + N) R^-1 (B'P + N') + Q = 0, eq. (3.10) of the thesis.

    Differentiable. Raises ValueError for matrices of wrong size, an R that is not positive
    definite, a Q with a negative eigenvalue, or if there is no stabilising solution; under `jit`
    and `vmap` the result is nan instead.
    """
    _check_weights(A, B, Q, R, N)
    state_matrix, G, H = _without_cross_weight(A, B, Q, R, N)
    return _require_finite(_care(state_matrix, G, H))


def lqr(
    A: Square, B: InputMatrix, Q: Square, R: InputWeight, N: InputMatrix | None = None
) -> GainAndCost:
    """Gain K (input, state) of u = -K x that minimises the integral of x'Qx + u'Ru + 2x'Nu, and P.

    K = R^-1 (B'P + N'), eqs (3.7) and (3.11) of the thesis. python-control's `lqr` also returns the
    poles. Raises as `care`.
    """
    cost = care(A, B, Q, R, N)
    cross = B.T @ cost if N is None else B.T @ cost + N.T
    return solve(R, cross), cost


def dare(
    A: Square, B: InputMatrix, Q: Square, R: InputWeight, N: InputMatrix | None = None
) -> Square:
    """Stabilising P of A'PA - (A'PB + N) (R + B'PB)^-1 (B'PA + N') + Q = P.

    Differentiable. Raises as `care`.
    """
    _check_weights(A, B, Q, R, N)
    state_matrix, G, H = _without_cross_weight(A, B, Q, R, N)
    return _require_finite(_dare(state_matrix, G, H))


def dlqr(
    A: Square, B: InputMatrix, Q: Square, R: InputWeight, N: InputMatrix | None = None
) -> GainAndCost:
    """Gain K (input, state) of u = -K x that minimises the sum of x'Qx + u'Ru + 2x'Nu, and P.

    K = (R + B'PB)^-1 (B'PA + N'). Raises as `care`.
    """
    cost = dare(A, B, Q, R, N)
    cross = B.T @ cost @ A if N is None else B.T @ cost @ A + N.T
    return solve(R + B.T @ cost @ B, cross), cost


def indefinite_dare(A: Square, G: Square, H: Square) -> Square:
    """Stabilising P of P = A'P (1 + G P)^-1 A + H for symmetric G and H of any sign.

    Differentiable; nan if the doubling finds none.
    """
    return _dare(A, G, H)


@custom_jvp
def _care(A, G, H):
    """Stabilising solution P of A'P + P A - P G P + H = 0."""
    A, G, H, unscale = _balanced(A, G, H)
    # Cayley's transform gives an equation in discrete time with the same solution.
    size = A.shape[0]
    shift = cayley_shift(A)
    shifted = solve(A - shift * xp.eye(size), xp.eye(size))
    mixed = solve(A.T - shift * xp.eye(size) + H @ shifted @ G, xp.eye(size))
    start = Interval(
        transition=xp.eye(size) + 2 * shift * mixed.T,
        G=symmetric_part(2 * shift * shifted @ G @ mixed),
        H=symmetric_part(2 * shift * mixed @ H @ shifted),
    )
    cost = _infinite_horizon_cost(start)
    for _ in range(2):
        closed_loop = A - G @ cost
        cost = symmetric_part(lyapunov(closed_loop, H + cost @ G @ cost))
    return unscale(cost)


@_care.defjvp
def _care_jvp(primals, tangents):
    A, G, _ = primals
    A_tangent, G_tangent, H_tangent = tangents
    cost = _care(*primals)
    half_source = cost @ A_tangent
    source = half_source + half_source.T - cost @ G_tangent @ cost + H_tangent
    return cost, lyapunov(A - G @ cost, source)


@custom_jvp
def _dare(A, G, H):
    """Stabilising solution P of P = A'P (1 + G P)^-1 A + H."""
    A, G, H, unscale = _balanced(A, G, H)
    cost = _infinite_horizon_cost(Interval(A, G, H))
    for _ in range(2):
        closed_loop = _closed_loop_matrix(A, G, cost)
        cost_closed_loop = cost @ closed_loop
        cost = symmetric_part(stein(closed_loop, H + cost_closed_loop.T @ G @ cost_closed_loop))
    return unscale(cost)


@_dare.defjvp
def _dare_jvp(primals, tangents):
    A, G, _ = primals
    A_tangent, G_tangent, H_tangent = tangents
    cost = _dare(*primals)
    closed_loop = _closed_loop_matrix(A, G, cost)
    cost_closed_loop = cost @ closed_loop
    half_source = cost_closed_loop.T @ A_tangent
    source = (
        half_source + half_source.T - cost_closed_loop.T @ G_tangent @ cost_closed_loop + H_tangent
    )
    return cost, stein(closed_loop, source)


def _balanced(A, G, H):
    """Matrices for balanced states and costates, and the function that scales their P back."""
    scale = balance(A)
    outer = scale * scale[:, None]
    A, G, H = A * scale / scale[:, None], G / outer, H * outer
    unit = _costate_unit(G, H)
    return A, G / unit, H * unit, lambda cost: cost / outer / unit


def _costate_unit(G, H):
    """Unit of the costate in which G and H have equal norms; one if either is zero."""
    G_size, H_size = xp.sum(G**2), xp.sum(H**2)
    both = (G_size > 0) & (H_size > 0)
    ratio = xp.where(both, G_size, 1.0) / xp.where(both, H_size, 1.0)
    return stop_gradient(ratio**0.25)


def _closed_loop_matrix(A, G, cost):
    """State matrix (1 + G P)^-1 A of the closed loop in discrete time."""
    return solve(xp.eye(A.shape[0]) + G @ cost, A)


def _infinite_horizon_cost(interval: Interval) -> Square:
    """H of an interval composed with itself until its transition vanishes.

    nan if that takes more than MAX_DOUBLINGS.
    """

    def unconverged(state):
        part, count = state
        return (xp.max(xp.abs(part.transition)) > TRANSITION_TOLERANCE) & (count < MAX_DOUBLINGS)

    part, _ = while_loop(unconverged, lambda s: (s[0].compose(s[0]), s[1] + 1), (interval, 0))
    return xp.where(xp.max(xp.abs(part.transition)) <= TRANSITION_TOLERANCE, part.H, xp.nan)


def _without_cross_weight(A, B, Q, R, N):
    """State matrix, G = B R^-1 B' and state weight of the equivalent problem without N."""
    inverse = solve(R, xp.eye(R.shape[0]))
    G = symmetric_part(B @ inverse @ B.T)
    if N is None:
        return A, G, Q
    return A - B @ inverse @ N.T, G, Q - symmetric_part(N @ inverse @ N.T)


def _check_weights(A, B, Q, R, N):
    """Raise ValueError for weights that define no optimal control."""
    states, inputs = B.shape
    expected_shapes = {
        "A": (states, states),
        "Q": (states, states),
        "R": (inputs, inputs),
        "N": B.shape,
    }
    for name, matrix in {"A": A, "Q": Q, "R": R, "N": N}.items():
        if matrix is not None and matrix.shape != expected_shapes[name]:
            raise ValueError(
                f"{name} must be {expected_shapes[name]} for a B of {B.shape}, not {matrix.shape}"
            )
    for name, weight in {"Q": Q, "R": R}.items():
        if not is_concrete(weight):
            continue
        weight = concrete(weight)
        size = np.max(np.abs(weight), initial=0.0)
        if np.max(np.abs(weight - weight.T), initial=0.0) > 1e-12 * size:
            raise ValueError(f"{name} must be symmetric; take the mean of it and its transpose")
        smallest_eigenvalue = np.min(np.linalg.eigvalsh(weight), initial=np.inf)
        if name == "R" and smallest_eigenvalue <= 0:
            raise ValueError(
                f"R must be positive definite; its least eigenvalue is {smallest_eigenvalue:g}"
            )
        if name == "Q" and smallest_eigenvalue < -1e-12 * size:
            raise ValueError(
                f"Q must be positive semidefinite; its least eigenvalue is {smallest_eigenvalue:g}"
            )


def _require_finite(cost):
    if is_concrete(cost) and not np.all(np.isfinite(concrete(cost))):
        raise ValueError(
            "there is no stabilising solution: an undamped or unstable mode is not controllable"
            " by the commands, or an undamped one is not weighted by Q"
        )
    return cost
