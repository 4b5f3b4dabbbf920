"""Tables of gains over a crossing: cubics between the edges of short stretches of time."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.motion import NEVER
from jaxbeam.riccati import lqr
from jaxbeam.statespace import LoadedBeam
from jaxbeam.stretches import NODES, Commands, Square, costs_to_go, riccati_rate, stretches

# Backward in time P hastens, right before an event, to what the plant from then on demands: in the
# last stretches, so many of them, edges come ever closer, each by a factor, so many times.
LAST, CLOSER, LAYER = 8, 0.9, 105
INSIDE = 1e-9  # of a stretch: how far within it its ends are looked at

# State matrix and command matrix at a time (s).
Plant = Callable[[Float[Array, ""]], tuple[Float[Array, "..."], Float[Array, "..."]]]


class GainTable(eqx.Module):
    """A gain as a function of the share of the crossing that is over, 0 to 1."""

    edges: Float[Array, " edge"]
    pieces: Float[Array, "stretch power input state"]

    def __call__(self, share: Float[Array, ""]) -> Float[Array, "input state"]:
        """The gain at a share of the crossing; before 0 and after 1 that at the end is held."""
        i = jnp.searchsorted(self.edges, share, side="right") - 1
        i = jnp.clip(i, 0, self.pieces.shape[0] - 1)
        length = self.edges[i + 1] - self.edges[i]
        part = (share - self.edges[i]) / jnp.where(length > 0, length, 1.0)
        powers = jnp.clip(part, 0.0, 1.0) ** np.arange(4)
        return jnp.tensordot(powers, self.pieces[i], axes=1)


def crossing(model: LoadedBeam) -> Float[Array, " event"]:
    """Times (s) at which loads enter and leave, ascending; the run's end for loads that stay."""
    windows = [path.window() for path in model.traffic.motions]
    events = jnp.sort(jnp.array(windows).reshape(-1))
    last = jnp.max(jnp.where(events < NEVER, events, model.case.run.duration))
    return jnp.minimum(events, last)


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
    plant: Plant, edges: Float[Array, " edge"], Q: Square, R: Commands, terminal: Square
) -> tuple[GainTable, Float[Array, "edge state state"]]:
    """Gains that minimise x'Fx at the last edge plus the integral of x'Qx + u'Ru, and P at edges.

    Eqs (3.3) to (3.9) of the thesis, (3.8) with its sign corrected; F is `terminal`.
    """
    lengths = jnp.diff(edges)
    times = edges[:-1, None] + lengths[:, None] * NODES
    A, B = jax.vmap(jax.vmap(plant))(times)
    costs = costs_to_go(stretches(A, B, Q, R, lengths), terminal)

    def gain(time, cost):
        return jnp.linalg.solve(R, plant(time)[1].T @ cost)

    def with_rate(time, cost):
        rate = riccati_rate(cost, *plant(time), Q, R)
        return jax.jvp(gain, (time, cost), (jnp.ones(()), rate))

    return _table(edges, with_rate, costs), costs


def step_by_step(plant: Plant, edges: Float[Array, " edge"], Q: Square, R: Commands) -> GainTable:
    """Gains for the plant frozen at each time, eqs (3.10) and (3.11) of the thesis."""

    def with_rate(time, _):
        return jax.jvp(lambda t: lqr(*plant(t), Q, R)[0], (time,), (jnp.ones(()),))

    return _table(edges, with_rate, edges)


def _table(edges, with_rate, at_edges) -> GainTable:
    """Cubics through gains and their rates just within both ends of every stretch."""
    lengths = jnp.diff(edges)
    nudge = INSIDE * lengths
    every = jax.vmap(with_rate)
    start, leaving = every(edges[:-1] + nudge, at_edges[:-1])
    end, arriving = every(edges[1:] - nudge, at_edges[1:])
    span = lengths[:, None, None]
    leaving, arriving, rise = leaving * span, arriving * span, end - start
    bend = 3 * rise - 2 * leaving - arriving, leaving + arriving - 2 * rise
    shares = (edges - edges[0]) / (edges[-1] - edges[0])
    return GainTable(shares, jnp.stack([start, leaving, *bend], axis=1))
