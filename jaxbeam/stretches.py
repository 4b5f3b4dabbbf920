"""Stretches of time, with which optimal control is carried backward along a varying plant.

Over a stretch the optimal state x and costate l = P x obey

    x(end) = drift x(start) - reach l(end),     l(start) = toll x(start) + drift' l(end),

with `reach` and `toll` symmetric and not negative. Two stretches joined are a stretch again:
joining is associative, and nothing in it grows, however stiff the plant. So they may be joined one
by one, or in parallel as a tree (Sarkka and Garcia-Fernandez, IEEE Trans. Automatic Control 68,
2023), or to themselves (see `riccati`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.holds import balance

Square = Float[Array, "state state"]
Inputs = Float[Array, "state input"]
Commands = Float[Array, "input input"]

STAGES = 6  # Gauss nodes of a stretch; order 12
NODES = (np.polynomial.legendre.leggauss(STAGES)[0] + 1) / 2


class Stretch(eqx.Module):
    """What a stretch of time does to optimal state and costate; see the module."""

    drift: Float[Array, "*batch state state"]
    reach: Float[Array, "*batch state state"]
    toll: Float[Array, "*batch state state"]

    def then(self, later: "Stretch") -> "Stretch":
        """This stretch followed by a later one."""
        back = _transposed(self.drift)
        between = jnp.eye(self.drift.shape[-1]) + self.reach @ later.toll
        passed = jnp.linalg.solve(between, jnp.concatenate([self.drift, self.reach], axis=-1))
        drift, reach = jnp.split(passed, 2, axis=-1)
        return Stretch(
            drift=later.drift @ drift,
            reach=later.reach + symmetric(later.drift @ reach @ _transposed(later.drift)),
            toll=self.toll + symmetric(back @ later.toll @ drift),
        )

    def before(self, cost: Square) -> Square:
        """P at its start for P at its end."""
        between = jnp.eye(cost.shape[-1]) + self.reach @ cost
        passed = jnp.linalg.solve(between, self.drift)
        return self.toll + symmetric(_transposed(self.drift) @ cost @ passed)


def stretches(
    A: Float[Array, "stretch stage state state"],
    B: Float[Array, "stretch stage state input"],
    Q: Square,
    R: Commands,
    lengths: Float[Array, " stretch"],
) -> Stretch:
    """Stretches of given lengths (s) along a plant known at their Gauss nodes, `NODES`.

    By collocation (order 12) of x' = A x - B R^-1 B' l, l' = -Q x - A' l as a problem with x given
    at the start and l at the end, so that a fast decay in either direction does no harm. Fast modes
    should turn by no more than about 2 rad in a stretch.
    """
    scale = balance(A[0, 0])
    inner, outer = jnp.eye(Q.shape[0]) * scale[:, None], scale * scale[:, None]
    inverse = jnp.linalg.inv(R)
    # The costate in a unit in which reach and toll are of like size.
    push = B / scale[:, None]
    reach = push @ inverse @ _transposed(push)
    unit = even_units(reach[0, 0], Q * outer)
    arguments = (A @ inner / scale[:, None], reach / unit, lengths)
    toll = Q * outer * unit

    def part(each):
        matrix, reach, length = each
        return _collocated(matrix, reach, length, toll)

    parts = jax.lax.map(part, arguments)
    return Stretch(
        drift=parts.drift * scale[:, None] / scale,
        reach=parts.reach * outer * unit,
        toll=parts.toll / outer / unit,
    )


def costs_to_go(
    parts: Stretch, terminal: Square, parallel: bool = False
) -> Float[Array, "edge state state"]:
    """P at the start of each of successive stretches and, last, at the end, where it is given.

    One after the other; or `parallel` in time, in twice the logarithm of their number of steps
    and about three times the work. On two CPU cores that takes as long and compiles some ten
    times as long; it can pay only where many more cores than designs are idle.
    """
    if parallel:

        def join(later, earlier):
            return earlier.then(later)

        onward = jax.lax.associative_scan(join, parts, reverse=True)
        costs = jax.vmap(lambda part: part.before(terminal))(onward)
    else:

        def back(cost, part):
            cost = part.before(cost)
            return cost, cost

        _, costs = jax.lax.scan(back, terminal, parts, reverse=True)
    return jnp.concatenate([costs, terminal[None]])


def riccati_rate(cost: Square, A: Square, B: Inputs, Q: Square, R: Commands) -> Square:
    """dP/dt = -P A - A'P - Q + P B R^-1 B'P, eq. (3.8) of the thesis with its sign corrected."""
    seen = B.T @ cost
    return -(cost @ A) - A.T @ cost - Q + seen.T @ jnp.linalg.solve(R, seen)


def _collocated(drift, reach, length, toll) -> Stretch:
    """The stretch of a plant with (stage, state, state) matrices; unknown are the rates h x', h l'.

    x_i = x_start + sum_j a_ij h x'_j and l_i = l_end - sum_j (b_j - a_ij) h l'_j.
    """
    size = drift.shape[-1]
    until = jnp.asarray(_WEIGHTS[None, :] - _UNTIL)
    past, left = _UNTIL[:, :, None, None], until[:, :, None, None]
    drift, reach, toll = length * drift, length * reach, length * toll
    back = _transposed(drift)
    blocks = jnp.stack(
        [
            jnp.stack([-past * drift[:, None], -left * reach[:, None]], axis=3),
            jnp.stack([past * toll, jnp.broadcast_to(-left * back[:, None], _shape(size))], axis=3),
        ],
        axis=2,
    )  # stage, stage, equation, row, unknown, column
    rows = 2 * STAGES * size
    matrix = jnp.eye(rows) + blocks.transpose(2, 0, 3, 4, 1, 5).reshape(rows, rows)
    right = jnp.stack(
        [
            jnp.stack([drift, -reach], axis=2),
            jnp.stack([jnp.broadcast_to(-toll, drift.shape), -back], axis=2),
        ]
    ).reshape(rows, 2 * size)
    rates = jnp.linalg.solve(matrix, right).reshape(2, STAGES, size, 2, size)
    change = jnp.einsum("j,ejrcs->ercs", _WEIGHTS, rates)
    return Stretch(
        drift=jnp.eye(size) + change[0, :, 0],
        reach=-symmetric(change[0, :, 1]),
        toll=-symmetric(change[1, :, 0]),
    )


def _shape(size):
    return STAGES, STAGES, size, size


def _gauss_tableau():
    """Weights a_ij (up to each node) and b_j (over all) of the Gauss collocation method."""
    powers = np.arange(1, STAGES + 1)
    vandermonde = NODES[:, None] ** (powers - 1)
    until = np.linalg.solve(vandermonde.T, (NODES[:, None] ** powers / powers).T).T
    return until, np.linalg.solve(vandermonde.T, 1 / powers)


_UNTIL, _WEIGHTS = _gauss_tableau()


def even_units(reach: Square, toll: Square) -> Float[Array, ""]:
    """The unit of the costate in which reach and toll are of like size; one if either is zero."""
    above, below = jnp.sum(reach**2), jnp.sum(toll**2)
    both = (above > 0) & (below > 0)
    ratio = jnp.where(both, above, 1.0) / jnp.where(both, below, 1.0)
    return jax.lax.stop_gradient(ratio**0.25)


def _transposed(matrix):
    return jnp.swapaxes(matrix, -1, -2)


def symmetric(matrix: Float[Array, "*batch state state"]) -> Float[Array, "*batch state state"]:
    """The symmetric part of a matrix."""
    return (matrix + _transposed(matrix)) / 2
