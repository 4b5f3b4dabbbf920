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

from jaxbeam.case.fields import is_known, known
from jaxbeam.numerics.discretisation import balance
from jaxbeam.numerics.intervals import Commands, Inputs, Square, Stretch, even_units, symmetric

Gain = tuple[Float[Array, "input state"], Square]

DOUBLINGS = 60  # at most, before an equation is taken for unsolvable
VANISHED = 1e-9  # norm of a drift whose square does not count


def care(A: Square, B: Inputs, Q: Square, R: Commands, N: Inputs | None = None) -> Square:
    """The stabilising P of A'P + P A - (P B + N) R^-1 (B'P + N') + Q = 0, eq. (3.10) of the thesis.

    Differentiable. Raises ValueError for matrices of wrong size, an R that is
    not positive, a Q that is indefinite, and if there is no stabilising solution; under `jit` and
    `vmap` the answer is nan instead.
    """
    _check(A, B, Q, R, N)
    drift, reach, toll = _without_cross(A, B, Q, R, N)
    return _solved(_care(drift, reach, toll))


def lqr(A: Square, B: Inputs, Q: Square, R: Commands, N: Inputs | None = None) -> Gain:
    """Gain K (input, state) of u = -K x with the least integral of x'Qx + u'Ru + 2x'Nu, and P.

    K = R^-1 (B'P + N'), eqs (3.7) and (3.11) of the thesis. Raises as `care`.
    """
    cost = care(A, B, Q, R, N)
    cross = B.T @ cost if N is None else B.T @ cost + N.T
    return jnp.linalg.solve(R, cross), cost


def dare(A: Square, B: Inputs, Q: Square, R: Commands, N: Inputs | None = None) -> Square:
    """The stabilising P of A'PA - (A'PB + N) (R + B'PB)^-1 (B'PA + N') + Q = P.

    Differentiable. Raises as `care`.
    """
    _check(A, B, Q, R, N)
    drift, reach, toll = _without_cross(A, B, Q, R, N)
    return _solved(_dare(drift, reach, toll))


def dlqr(A: Square, B: Inputs, Q: Square, R: Commands, N: Inputs | None = None) -> Gain:
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
        pole = _pole(matrix)
        inverse = jnp.linalg.inv(pole * jnp.eye(matrix.shape[0]) - matrix)
        drift = inverse @ (pole * jnp.eye(matrix.shape[0]) + matrix)
        return _doubled_sum(drift, 2 * pole * inverse.T @ right @ inverse)

    found = jax.lax.custom_linear_solve(
        lambda x: -(scaled.T @ x + x @ scaled),
        S * outer,
        lambda _, right: solve(scaled, right),
        lambda _, right: solve(scaled.T, right),
    )
    return found / outer


def stein(A: Square, S: Square) -> Square:
    """X of A'X A - X + S = 0 for an A with eigenvalues within the unit circle; differentiable."""
    scale = balance(A)
    scaled = A * scale / scale[:, None]
    outer = scale * scale[:, None]
    found = jax.lax.custom_linear_solve(
        lambda x: x - scaled.T @ x @ scaled,
        S * outer,
        lambda _, right: _doubled_sum(scaled, right),
        lambda _, right: _doubled_sum(scaled.T, right),
    )
    return found / outer


@jax.custom_jvp
def _care(drift, reach, toll):
    """P of drift'P + P drift - P reach P + toll = 0."""
    scale = balance(drift)
    outer = scale * scale[:, None]
    drift, reach, toll = drift * scale / scale[:, None], reach / outer, toll * outer
    unit = even_units(reach, toll)
    reach, toll = reach / unit, toll * unit
    # Cayley's transform makes of it an equation in discrete time with the same solution.
    size = drift.shape[0]
    pole = _pole(drift)
    shifted = jnp.linalg.inv(drift - pole * jnp.eye(size))
    mixed = jnp.linalg.inv(drift.T - pole * jnp.eye(size) + toll @ shifted @ reach)
    start = Stretch(
        drift=jnp.eye(size) + 2 * pole * mixed.T,
        reach=symmetric(2 * pole * shifted @ reach @ mixed),
        toll=symmetric(2 * pole * mixed @ toll @ shifted),
    )
    cost = _endless(start)
    for _ in range(2):
        onward = drift - reach @ cost
        cost = symmetric(lyapunov(onward, toll + cost @ reach @ cost))
    return cost / outer / unit


@_care.defjvp
def _care_jvp(primals, tangents):
    drift, reach, _ = primals
    drift_change, reach_change, toll_change = tangents
    cost = _care(*primals)
    felt = cost @ drift_change
    source = felt + felt.T - cost @ reach_change @ cost + toll_change
    return cost, lyapunov(drift - reach @ cost, source)


@jax.custom_jvp
def _dare(drift, reach, toll):
    """P of P = drift'P (1 + reach P)^-1 drift + toll."""
    scale = balance(drift)
    outer = scale * scale[:, None]
    drift, reach, toll = drift * scale / scale[:, None], reach / outer, toll * outer
    unit = even_units(reach, toll)
    reach, toll = reach / unit, toll * unit
    cost = _endless(Stretch(drift, reach, toll))
    for _ in range(2):
        onward = _closed(drift, reach, cost)
        spent = cost @ onward
        cost = symmetric(stein(onward, toll + spent.T @ reach @ spent))
    return cost / outer / unit


@_dare.defjvp
def _dare_jvp(primals, tangents):
    drift, reach, _ = primals
    drift_change, reach_change, toll_change = tangents
    cost = _dare(*primals)
    onward = _closed(drift, reach, cost)
    spent = cost @ onward
    felt = spent.T @ drift_change
    source = felt + felt.T - spent.T @ reach_change @ spent + toll_change
    return cost, stein(onward, source)


def _closed(drift, reach, cost):
    """State matrix of the closed loop in discrete time."""
    return jnp.linalg.solve(jnp.eye(drift.shape[0]) + reach @ cost, drift)


def _endless(start: Stretch) -> Square:
    """The toll of a stretch joined to itself for ever; nan if its drift does not die away."""

    def lasts(state):
        part, count = state
        return (jnp.max(jnp.abs(part.drift)) > VANISHED) & (count < DOUBLINGS)

    part, _ = jax.lax.while_loop(lasts, lambda s: (s[0].then(s[0]), s[1] + 1), (start, 0))
    return jnp.where(jnp.max(jnp.abs(part.drift)) <= VANISHED, part.toll, jnp.nan)


def _doubled_sum(drift, first):
    """The sum of drift'^k first drift^k over all k, twice as many terms at a time."""

    def lasts(state):
        _, power, count = state
        return (jnp.max(jnp.abs(power)) > VANISHED) & (count < DOUBLINGS)

    def double(state):
        total, power, count = state
        return total + power.T @ total @ power, power @ power, count + 1

    total, power, _ = jax.lax.while_loop(lasts, double, (first, drift, 0))
    return jnp.where(jnp.max(jnp.abs(power)) <= VANISHED, total, jnp.nan)


def _pole(matrix):
    """A rate larger than that of any eigenvalue, at which Cayley's transform is centred."""
    return 1.1 * jnp.max(jnp.sum(jnp.abs(matrix), axis=1)) + jnp.finfo(float).tiny


def _without_cross(A, B, Q, R, N):
    """State matrix, B R^-1 B' and state weight of the same problem without a cross weight."""
    inverse = jnp.linalg.inv(R)
    reach = symmetric(B @ inverse @ B.T)
    if N is None:
        return A, reach, Q
    return A - B @ inverse @ N.T, reach, Q - symmetric(N @ inverse @ N.T)


def _check(A, B, Q, R, N):
    """Raise ValueError for matrices that pose no problem of optimal control."""
    states, inputs = B.shape
    wanted = {"A": (states, states), "Q": (states, states), "R": (inputs, inputs), "N": B.shape}
    for name, matrix in {"A": A, "Q": Q, "R": R, "N": N}.items():
        if matrix is not None and matrix.shape != wanted[name]:
            raise ValueError(
                f"{name} must be {wanted[name]} for a B of {B.shape}, not {matrix.shape}"
            )
    for name, weight in {"Q": Q, "R": R}.items():
        if not is_known(weight):
            continue
        weight = known(weight)
        size = np.max(np.abs(weight), initial=0.0)
        if np.max(np.abs(weight - weight.T), initial=0.0) > 1e-12 * size:
            raise ValueError(f"{name} must be symmetric; take the mean of it and its transpose")
        least = np.min(np.linalg.eigvalsh(weight), initial=np.inf)
        if name == "R" and least <= 0:
            raise ValueError(f"R must be positive definite; its least eigenvalue is {least:g}")
        if name == "Q" and least < -1e-12 * size:
            raise ValueError(f"Q must not be negative; its least eigenvalue is {least:g}")


def _solved(cost):
    if is_known(cost) and not np.all(np.isfinite(known(cost))):
        raise ValueError(
            "there is no stabilising solution: some undamped or growing mode is out of the reach"
            " of the commands, or undamped and not weighted by Q"
        )
    return cost
