"""Algebraic Riccati, Lyapunov and Stein equations, in continuous and in discrete time.

A Riccati equation is solved by joining a stretch of time to itself until it is infinitely long,
the structured doubling algorithm (Chu, Fan, Lin and Wang, Int. J. Control 77, 2004), and refined
by Newton's method (Kleinman, IEEE Trans. Automatic Control 13, 1968). It needs no eigenvalues, so
it runs on every device, in batches; derivatives are implicit, forward and in reverse.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.numerics.discretisation import balance
from jaxbeam.numerics.intervals import (
    InputMatrix,
    InputWeight,
    Interval,
    Square,
    costate_unit,
    symmetric_part,
)

GainAndCost = tuple[Float[Array, "input state"], Square]

MAX_DOUBLINGS = 60  # at most, before an equation is taken for unsolvable
TRANSITION_TOLERANCE = 1e-9  # norm of a drift whose square does not count


def care(
    A: Square, B: InputMatrix, Q: Square, R: InputWeight, N: InputMatrix | None = None
) -> Square:
    """The stabilising P of A'P + P A - (P B + N) R^-1 (B'P + N') + Q = 0, eq. (3.10) of the thesis.

    Differentiable. Raises ValueError for matrices of wrong size, an R that is
    not positive, a Q that is indefinite, and if there is no stabilising solution; under `jit` and
    `vmap` the answer is nan instead.
    """
    _check_weights(A, B, Q, R, N)
    state_matrix, G, H = _without_cross_weight(A, B, Q, R, N)
    return _require_finite(_care(state_matrix, G, H))


def lqr(
    A: Square, B: InputMatrix, Q: Square, R: InputWeight, N: InputMatrix | None = None
) -> GainAndCost:
    """Gain K (input, state) of u = -K x with the least integral of x'Qx + u'Ru + 2x'Nu, and P.

    K = R^-1 (B'P + N'), eqs (3.7) and (3.11) of the thesis. Raises as `care`.
    """
    cost = care(A, B, Q, R, N)
    cross = B.T @ cost if N is None else B.T @ cost + N.T
    return jnp.linalg.solve(R, cross), cost


def dare(
    A: Square, B: InputMatrix, Q: Square, R: InputWeight, N: InputMatrix | None = None
) -> Square:
    """The stabilising P of A'PA - (A'PB + N) (R + B'PB)^-1 (B'PA + N') + Q = P.

    Differentiable. Raises as `care`.
    """
    _check_weights(A, B, Q, R, N)
    state_matrix, G, H = _without_cross_weight(A, B, Q, R, N)
    return _require_finite(_dare(state_matrix, G, H))


def dlqr(
    A: Square, B: InputMatrix, Q: Square, R: InputWeight, N: InputMatrix | None = None
) -> GainAndCost:
    """Gain K (input, state) of u = -K x with the least sum of x'Qx + u'Ru + 2x'Nu, and P.

    Raises as `care`.
    """
    cost = dare(A, B, Q, R, N)
    cross = B.T @ cost @ A if N is None else B.T @ cost @ A + N.T
    return jnp.linalg.solve(R + B.T @ cost @ B, cross), cost


def lyapunov(A: Square, S: Square) -> Square:
    """X of A'X + X A + S = 0 for a stable A; differentiable."""
    scale = balance(A)
    scaled = A * scale / scale[:, None]
    outer = scale * scale[:, None]

    def solve(matrix, right):
        shift = _cayley_shift(matrix)
        inverse = jnp.linalg.inv(shift * jnp.eye(matrix.shape[0]) - matrix)
        discrete_matrix = inverse @ (shift * jnp.eye(matrix.shape[0]) + matrix)
        return _stein_series(discrete_matrix, 2 * shift * inverse.T @ right @ inverse)

    scaled_solution = jax.lax.custom_linear_solve(
        lambda x: -(scaled.T @ x + x @ scaled),
        S * outer,
        lambda _, right: solve(scaled, right),
        lambda _, right: solve(scaled.T, right),
    )
    return scaled_solution / outer


def stein(A: Square, S: Square) -> Square:
    """X of A'X A - X + S = 0 for an A with eigenvalues within the unit circle; differentiable."""
    scale = balance(A)
    scaled = A * scale / scale[:, None]
    outer = scale * scale[:, None]
    scaled_solution = jax.lax.custom_linear_solve(
        lambda x: x - scaled.T @ x @ scaled,
        S * outer,
        lambda _, right: _stein_series(scaled, right),
        lambda _, right: _stein_series(scaled.T, right),
    )
    return scaled_solution / outer


@jax.custom_jvp
def _care(A, G, H):
    """P of drift'P + P drift - P reach P + toll = 0."""
    scale = balance(A)
    outer = scale * scale[:, None]
    A, G, H = A * scale / scale[:, None], G / outer, H * outer
    unit = costate_unit(G, H)
    G, H = G / unit, H * unit
    # Cayley's transform makes of it an equation in discrete time with the same solution.
    size = A.shape[0]
    shift = _cayley_shift(A)
    shifted = jnp.linalg.inv(A - shift * jnp.eye(size))
    mixed = jnp.linalg.inv(A.T - shift * jnp.eye(size) + H @ shifted @ G)
    start = Interval(
        transition=jnp.eye(size) + 2 * shift * mixed.T,
        G=symmetric_part(2 * shift * shifted @ G @ mixed),
        H=symmetric_part(2 * shift * mixed @ H @ shifted),
    )
    cost = _doubled_to_infinity(start)
    for _ in range(2):
        closed_loop = A - G @ cost
        cost = symmetric_part(lyapunov(closed_loop, H + cost @ G @ cost))
    return cost / outer / unit


@_care.defjvp
def _care_jvp(primals, tangents):
    A, G, _ = primals
    A_tangent, G_tangent, H_tangent = tangents
    cost = _care(*primals)
    half_source = cost @ A_tangent
    source = half_source + half_source.T - cost @ G_tangent @ cost + H_tangent
    return cost, lyapunov(A - G @ cost, source)


@jax.custom_jvp
def _dare(A, G, H):
    """P of P = drift'P (1 + reach P)^-1 drift + toll."""
    scale = balance(A)
    outer = scale * scale[:, None]
    A, G, H = A * scale / scale[:, None], G / outer, H * outer
    unit = costate_unit(G, H)
    G, H = G / unit, H * unit
    cost = _doubled_to_infinity(Interval(A, G, H))
    for _ in range(2):
        closed_loop = _closed_loop_matrix(A, G, cost)
        cost_closed_loop = cost @ closed_loop
        cost = symmetric_part(stein(closed_loop, H + cost_closed_loop.T @ G @ cost_closed_loop))
    return cost / outer / unit


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


def _closed_loop_matrix(A, G, cost):
    """State matrix of the closed loop in discrete time."""
    return jnp.linalg.solve(jnp.eye(A.shape[0]) + G @ cost, A)


def _doubled_to_infinity(interval: Interval) -> Square:
    """The toll of a stretch joined to itself for ever; nan if its drift does not die away."""

    def unconverged(state):
        part, count = state
        return (jnp.max(jnp.abs(part.transition)) > TRANSITION_TOLERANCE) & (count < MAX_DOUBLINGS)

    part, _ = jax.lax.while_loop(
        unconverged, lambda s: (s[0].compose(s[0]), s[1] + 1), (interval, 0)
    )
    return jnp.where(jnp.max(jnp.abs(part.transition)) <= TRANSITION_TOLERANCE, part.H, jnp.nan)


def _stein_series(A, first_term):
    """The sum of drift'^k first drift^k over all k, twice as many terms at a time."""

    def unconverged(state):
        _, power, count = state
        return (jnp.max(jnp.abs(power)) > TRANSITION_TOLERANCE) & (count < MAX_DOUBLINGS)

    def double(state):
        total, power, count = state
        return total + power.T @ total @ power, power @ power, count + 1

    total, power, _ = jax.lax.while_loop(unconverged, double, (first_term, A, 0))
    return jnp.where(jnp.max(jnp.abs(power)) <= TRANSITION_TOLERANCE, total, jnp.nan)


def _cayley_shift(matrix):
    """A rate larger than that of any eigenvalue, at which Cayley's transform is centred."""
    return 1.1 * jnp.max(jnp.sum(jnp.abs(matrix), axis=1)) + jnp.finfo(float).tiny


def _without_cross_weight(A, B, Q, R, N):
    """State matrix, B R^-1 B' and state weight of the same problem without a cross weight."""
    inverse = jnp.linalg.inv(R)
    G = symmetric_part(B @ inverse @ B.T)
    if N is None:
        return A, G, Q
    return A - B @ inverse @ N.T, G, Q - symmetric_part(N @ inverse @ N.T)


def _check_weights(A, B, Q, R, N):
    """Raise ValueError for matrices that pose no problem of optimal control."""
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
                f"Q must not be negative; its least eigenvalue is {smallest_eigenvalue:g}"
            )


def _require_finite(cost):
    if is_concrete(cost) and not np.all(np.isfinite(concrete(cost))):
        raise ValueError(
            "there is no stabilising solution: some undamped or growing mode is out of the reach"
            " of the commands, or undamped and not weighted by Q"
        )
    return cost
