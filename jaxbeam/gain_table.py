"""Tables of gains along a time: polynomials between the edges of short stretches of it."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.riccati import lqr
from jaxbeam.stretches import NODES, Commands, Square, costs_to_go, riccati_rate, stretches

# Backward in time P hastens, right before an event, to what the plant from then on demands: in the
# last stretches, so many of them, edges come ever closer, each by a factor, so many times.
LAST, CLOSER, LAYER = 8, 0.9, 105
INSIDE = 1e-9  # of a stretch: how far within it its ends are looked at, step by step

# State matrix and command matrix at a time (s).
Plant = Callable[[Float[Array, ""]], tuple[Float[Array, "..."], Float[Array, "..."]]]


class GainTable(eqx.Module):
    """A gain as a function of the share of its time that is over, 0 to 1."""

    edges: Float[Array, " edge"]
    pieces: Float[Array, "stretch power input state"]

    def __call__(self, share: Float[Array, ""]) -> Float[Array, "input state"]:
        """The gain at a share of the time; before 0 and after 1 that at the end is held."""
        i = jnp.searchsorted(self.edges, share, side="right") - 1
        i = jnp.clip(i, 0, self.pieces.shape[0] - 1)
        length = self.edges[i + 1] - self.edges[i]
        part = (share - self.edges[i]) / jnp.where(length > 0, length, 1.0)
        powers = jnp.clip(part, 0.0, 1.0) ** np.arange(self.pieces.shape[1])
        return jnp.tensordot(powers, self.pieces[i], axes=1)


def edges_between(
    events: Float[Array, " event"], shares: Float[np.ndarray, " share"]
) -> Float[Array, " edge"]:
    """Edges (s) of stretches: at these shares, from 0 on, of the time from event to event."""
    inner = events[:-1, None] + jnp.diff(events)[:, None] * shares
    return jnp.append(inner.reshape(-1), events[-1])


def even(count: int) -> Float[np.ndarray, " share"]:
    """Shares for so many equal stretches."""
    return np.arange(count) / count


def hastening(count: int) -> Float[np.ndarray, " share"]:
    """Shares for so many equal stretches, but for the fine layer at the end."""
    return np.concatenate([even(count)[: -min(LAST, count)], 1 - layer(count)])


def layer(count: int) -> Float[np.ndarray, " edge"]:
    """Edges of the fine layer before an event, as shares of the time since the one before."""
    return min(LAST, count) / count * CLOSER ** np.arange(LAYER + 1)


def finite_time(
    plant: Plant,
    edges: Float[Array, " edge"],
    Q: Square,
    R: Commands,
    terminal: Square,
    parallel: bool = False,
) -> tuple[GainTable, Float[Array, "edge state state"]]:
    """Gains that minimise x'Fx at the last edge plus the integral of x'Qx + u'Ru, and P at edges.

    Eqs (3.3) to (3.9) of the thesis, (3.8) with its sign corrected; F is `terminal`. P is carried
    from stretch to stretch one after the other, or in `parallel` (see `costs_to_go`).
    """
    lengths = jnp.diff(edges)
    times = edges[:-1, None] + lengths[:, None] * NODES
    A, B = jax.vmap(jax.vmap(plant))(times)
    costs = costs_to_go(stretches(A, B, Q, R, lengths), terminal, parallel)
    # The plant at the ends of a stretch, and its rates, from what it is at the nodes within.
    A, B = (jnp.einsum("erj,sj...->esr...", AT_ENDS, part) for part in (A, B))

    def gains(A, B, cost, length):
        """The gain, its rate and the rate of that, as the plant is given, by share of a stretch."""

        def rate(cost, A, B):
            return length * riccati_rate(cost, A, B, Q, R)

        first = rate(cost, A[0], B[0])
        second = jax.jvp(rate, (cost, A[0], B[0]), (first, A[1], B[1]))[1]
        rows = [
            B[0].T @ cost,
            B[1].T @ cost + B[0].T @ first,
            B[2].T @ cost + 2 * B[1].T @ first + B[0].T @ second,
        ]
        return jax.vmap(lambda row: jnp.linalg.solve(R, row))(jnp.stack(rows))

    every = jax.vmap(gains)
    starts = every(A[0], B[0], costs[:-1], lengths)
    ends = every(A[1], B[1], costs[1:], lengths)
    return _table(edges, starts, ends), costs


def step_by_step(plant: Plant, edges: Float[Array, " edge"], Q: Square, R: Commands) -> GainTable:
    """Gains for the plant frozen at each time, eqs (3.10) and (3.11) of the thesis."""

    lengths = jnp.diff(edges)
    nudge = INSIDE * lengths

    def gains(time, length):
        gain, rate = jax.jvp(lambda t: lqr(*plant(t), Q, R)[0], (time,), (length,))
        return jnp.stack([gain, rate])

    every = jax.vmap(gains)
    return _table(edges, every(edges[:-1] + nudge, lengths), every(edges[1:] - nudge, lengths))


def _table(edges, starts, ends) -> GainTable:
    """Polynomials through gains and their rates (stretch, rate, ...) at both ends of stretches."""
    low, high = _hermite(starts.shape[1])
    pieces = jnp.einsum("pr,sriz->spiz", low, starts) + jnp.einsum("pr,sriz->spiz", high, ends)
    return GainTable((edges - edges[0]) / (edges[-1] - edges[0]), pieces)


def _rates(at: float, orders: int, powers: int) -> Float[np.ndarray, "order power"]:
    """The powers of a number, and their rates up to an order."""
    exponents = np.arange(powers)
    factors = [np.prod([exponents - k for k in range(r)], axis=0) for r in range(orders)]
    left = [np.maximum(exponents - r, 0) for r in range(orders)]
    return np.stack([factor * at**rest for factor, rest in zip(factors, left, strict=True)])


def _hermite(orders: int) -> tuple[Float[np.ndarray, "power order"], ...]:
    """What takes a value and its rates at 0, and those at 1, to the polynomial through them."""
    rows = [_rates(at, orders, 2 * orders) for at in (0.0, 1.0)]
    inverse = np.linalg.inv(np.concatenate(rows))
    return inverse[:, :orders], inverse[:, orders:]


# What takes values at the nodes to that at each end, and to its first two rates there.
AT_ENDS = np.stack([_rates(at, 3, NODES.size) for at in (0.0, 1.0)]) @ np.linalg.inv(
    NODES[:, None] ** np.arange(NODES.size)
)
