"""Tables of gains along a time: polynomials between the edges of short stretches of it."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.numerics.intervals import Commands, Square
from jaxbeam.numerics.riccati import lqr
from jaxbeam.numerics.stages import NODES

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


def step_by_step(plant: Plant, edges: Float[Array, " edge"], Q: Square, R: Commands) -> GainTable:
    """Gains for the plant frozen at each time, eqs (3.10) and (3.11) of the thesis."""

    lengths = jnp.diff(edges)
    nudge = INSIDE * lengths

    def gains(time, length):
        gain, rate = jax.jvp(lambda t: lqr(*plant(t), Q, R)[0], (time,), (length,))
        return jnp.stack([gain, rate])

    every = jax.vmap(gains, out_axes=1)
    pieces = polynomials(every(edges[:-1] + nudge, lengths), every(edges[1:] - nudge, lengths))
    return GainTable((edges - edges[0]) / (edges[-1] - edges[0]), pieces)


def polynomials(
    starts: Float[Array, "rate stretch *gain"], ends: Float[Array, "rate stretch *gain"]
) -> Float[Array, "stretch power *gain"]:
    """Polynomials through values and their rates at both ends of stretches."""
    low, high = hermite(starts.shape[0])
    return jnp.moveaxis(jnp.tensordot(low, starts, 1) + jnp.tensordot(high, ends, 1), 0, 1)


def from_nodes(
    values: Float[Array, "stretch stage *value"],
) -> Float[Array, "edge rate *value"]:
    """What takes values at nodes, with its first two rates, at the starts of stretches and the end.

    That of the last stretch, if others follow.
    """
    starts = jnp.einsum("rj,sj...->sr...", AT_ENDS[0], values)
    return jnp.concatenate([starts, jnp.einsum("rj,j...->r...", AT_ENDS[1], values[-1])[None]])


def _rates(at: float, orders: int, powers: int) -> Float[np.ndarray, "order power"]:
    """The powers of a number, and their rates up to an order."""
    exponents = np.arange(powers)
    factors = [np.prod([exponents - k for k in range(r)], axis=0) for r in range(orders)]
    left = [np.maximum(exponents - r, 0) for r in range(orders)]
    return np.stack([factor * at**rest for factor, rest in zip(factors, left, strict=True)])


def hermite(orders: int) -> tuple[Float[np.ndarray, "power order"], ...]:
    """What takes a value and its rates at 0, and those at 1, to the polynomial through them."""
    rows = [_rates(at, orders, 2 * orders) for at in (0.0, 1.0)]
    inverse = np.linalg.inv(np.concatenate(rows))
    return inverse[:, :orders], inverse[:, orders:]


# What takes values at the nodes to that at each end, and to its first two rates there.
AT_ENDS = np.stack([_rates(at, 3, NODES.size) for at in (0.0, 1.0)]) @ np.linalg.inv(
    NODES[:, None] ** np.arange(NODES.size)
)
