"""Tables of gains along a time: polynomials between the edges of short stretches of it."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.numerics.intervals import InputWeight, Square
from jaxbeam.numerics.riccati import lqr
from jaxbeam.numerics.stages import GAUSS_NODES

END_OFFSET = 1e-9  # of a stretch: how far within it its ends are looked at, step by step

# State matrix and command matrix at a time (s).
PlantMatrices = Callable[[Float[Array, ""]], tuple[Float[Array, "..."], Float[Array, "..."]]]


class GainTable(eqx.Module):
    """A gain as a function of the share of its time that is over, 0 to 1."""

    breakpoints: Float[Array, " edge"]
    coefficients: Float[Array, "stretch power input state"]

    def __call__(self, fraction: Float[Array, ""]) -> Float[Array, "input state"]:
        """The gain at a share of the time; before 0 and after 1 that at the end is held."""
        i = jnp.searchsorted(self.breakpoints, fraction, side="right") - 1
        i = jnp.clip(i, 0, self.coefficients.shape[0] - 1)
        length = self.breakpoints[i + 1] - self.breakpoints[i]
        interval_fraction = (fraction - self.breakpoints[i]) / jnp.where(length > 0, length, 1.0)
        powers = jnp.clip(interval_fraction, 0.0, 1.0) ** np.arange(self.coefficients.shape[1])
        return jnp.tensordot(powers, self.coefficients[i], axes=1)


def breakpoints_between(
    events: Float[Array, " event"], fractions: Float[np.ndarray, " share"]
) -> Float[Array, " edge"]:
    """Edges (s) of stretches: at these shares, from 0 on, of the time from event to event."""
    inner = events[:-1, None] + jnp.diff(events)[:, None] * fractions
    return jnp.append(inner.reshape(-1), events[-1])


def uniform_fractions(intervals: int) -> Float[np.ndarray, " share"]:
    """Shares for so many equal stretches."""
    return np.arange(intervals) / intervals


def frozen_time_gains(
    plant: PlantMatrices, breakpoints: Float[Array, " edge"], Q: Square, R: InputWeight
) -> GainTable:
    """Gains for the plant frozen at each time, eqs (3.10) and (3.11) of the thesis."""

    lengths = jnp.diff(breakpoints)
    offset = END_OFFSET * lengths

    def gain_and_rate(time, length):
        gain, rate = jax.jvp(lambda t: lqr(*plant(t), Q, R)[0], (time,), (length,))
        return jnp.stack([gain, rate])

    gains_at = jax.vmap(gain_and_rate, out_axes=1)
    coefficients = hermite_polynomials(
        gains_at(breakpoints[:-1] + offset, lengths), gains_at(breakpoints[1:] - offset, lengths)
    )
    return GainTable(
        (breakpoints - breakpoints[0]) / (breakpoints[-1] - breakpoints[0]), coefficients
    )


def hermite_polynomials(
    starts: Float[Array, "rate stretch *gain"], ends: Float[Array, "rate stretch *gain"]
) -> Float[Array, "stretch power *gain"]:
    """Polynomials through values and their rates at both ends of stretches."""
    start_matrix, end_matrix = hermite_matrices(starts.shape[0])
    return jnp.moveaxis(
        jnp.tensordot(start_matrix, starts, 1) + jnp.tensordot(end_matrix, ends, 1), 0, 1
    )


def derivatives_at_breakpoints(
    values: Float[Array, "stretch stage *value"],
) -> Float[Array, "edge rate *value"]:
    """What takes values at nodes, with its first two rates, at the starts of stretches and the end.

    That of the last stretch, if others follow.
    """
    starts = jnp.einsum("rj,sj...->sr...", NODES_TO_ENDS[0], values)
    return jnp.concatenate(
        [starts, jnp.einsum("rj,j...->r...", NODES_TO_ENDS[1], values[-1])[None]]
    )


def _power_derivatives(
    position: float, orders: int, powers: int
) -> Float[np.ndarray, "order power"]:
    """The powers of a number, and their rates up to an order."""
    exponents = np.arange(powers)
    factors = [np.prod([exponents - k for k in range(r)], axis=0) for r in range(orders)]
    remaining_exponents = [np.maximum(exponents - r, 0) for r in range(orders)]
    return np.stack(
        [factor * position**rest for factor, rest in zip(factors, remaining_exponents, strict=True)]
    )


def hermite_matrices(orders: int) -> tuple[Float[np.ndarray, "power order"], ...]:
    """What takes a value and its rates at 0, and those at 1, to the polynomial through them."""
    rows = [_power_derivatives(at, orders, 2 * orders) for at in (0.0, 1.0)]
    inverse = np.linalg.inv(np.concatenate(rows))
    return inverse[:, :orders], inverse[:, orders:]


# What takes values at the nodes to that at each end, and to its first two rates there.
NODES_TO_ENDS = np.stack(
    [_power_derivatives(at, 3, GAUSS_NODES.size) for at in (0.0, 1.0)]
) @ np.linalg.inv(GAUSS_NODES[:, None] ** np.arange(GAUSS_NODES.size))
