"""Lyapunov and Stein equations, by doubling: on every device, in batches, differentiable."""

from collections.abc import Callable

import jax
from jaxtyping import Float

from jaxbeam.numerics.discretisation import balance
from jaxbeam.numerics.matrices import Square
from jaxbeam.runtime.arrays import Array, any_jax, solve, while_loop, xp

MAX_DOUBLINGS = 60  # after which an equation is taken for unsolvable
TRANSITION_TOLERANCE = 1e-9  # norm of a transition matrix whose square is below rounding


def lyapunov(A: Square, S: Square) -> Square:
    """X of A'X + X A + S = 0 for a stable A; nan for another."""

    def sum_of_series(matrix, right):
        shift, identity = cayley_shift(matrix), xp.eye(matrix.shape[0])
        inverse = solve(shift * identity - matrix, identity)
        discrete_matrix = inverse @ (shift * identity + matrix)
        return _stein_series(discrete_matrix, 2 * shift * inverse.T @ right @ inverse)

    return _solve_balanced(A, S, lambda A, X: -(A.T @ X + X @ A), sum_of_series)


def stein(A: Square, S: Square) -> Square:
    """X of A'X A - X + S = 0 for an A with eigenvalues in the unit circle; nan for another."""
    return _solve_balanced(A, S, lambda A, X: X - A.T @ X @ A, _stein_series)


def cayley_shift(matrix: Square) -> Float[Array, ""]:
    """A rate above that of any eigenvalue, as the centre of Cayley's transform."""
    return 1.1 * xp.max(xp.sum(xp.abs(matrix), axis=1)) + xp.finfo(float).tiny


def _solve_balanced(A: Square, S: Square, operator: Callable, solution: Callable) -> Square:
    """X of operator(A, X) = S, linear in X, by `solution` for the balanced A."""
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
