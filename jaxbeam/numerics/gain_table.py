"""Gain tables: gains as piecewise polynomials over a fraction of time, between breakpoints."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.numerics.matrices import InputWeight, Square
from jaxbeam.numerics.riccati import lqr
from jaxbeam.numerics.stages import GAUSS_NODES
from jaxbeam.runtime.arrays import Array, take, xp
from jaxbeam.runtime.module import Module

END_OFFSET = 1e-9  # of an interval: ends are evaluated so far inside, as the plant may jump there

# State matrix A and input matrix B at a time (s).
PlantMatrices = Callable[[Float[Array, ""]], tuple[Float[Array, "..."], Float[Array, "..."]]]


class GainTable(Module):
    """Gain as a function of the fraction, 0 to 1, of its time span."""

    breakpoints: Float[Array, " breakpoint"]
    coefficients: Float[Array, "interval power input state"]

    def __call__(self, fraction: Float[Array, ""]) -> Float[Array, "input state"]:
        """Gain at a fraction of the time span; held before 0 and after 1."""
        i = xp.searchsorted(self.breakpoints, fraction, side="right") - 1
        i = xp.clip(i, 0, self.coefficients.shape[0] - 1)
        start = take(self.breakpoints, i)
        length = take(self.breakpoints, i + 1) - start
        interval_fraction = (fraction - start) / xp.where(length > 0, length, 1.0)
        powers = xp.clip(interval_fraction, 0.0, 1.0) ** np.arange(self.coefficients.shape[1])
        return xp.tensordot(powers, take(self.coefficients, i), axes=1)


def breakpoints_between(
    events: Float[Array, " event"], fractions: Float[np.ndarray, " fraction"]
) -> Float[Array, " breakpoint"]:
    """Breakpoints (s) at fractions, from 0, of the time from each event to the next."""
    inner = events[:-1, None] + jnp.diff(events)[:, None] * fractions
    return jnp.append(inner.reshape(-1), events[-1])


def uniform_fractions(intervals: int) -> Float[np.ndarray, " fraction"]:
    """Fractions at the starts of equal intervals."""
    return np.arange(intervals) / intervals


def frozen_time_gains(
    plant: PlantMatrices, breakpoints: Float[Array, " breakpoint"], Q: Square, R: InputWeight
) -> GainTable:
    """Infinite-horizon gains of the plant frozen at each time, eqs (3.10) and (3.11) of the thesis.

    Cubics between the breakpoints (s), from the gains and their rates there. Raises as `lqr`.
    """
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
    starts: Float[Array, "order interval *gain"], ends: Float[Array, "order interval *gain"]
) -> Float[Array, "interval power *gain"]:
    """Polynomials through values and their derivatives at both ends of intervals."""
    start_matrix, end_matrix = hermite_matrices(starts.shape[0])
    return jnp.moveaxis(
        jnp.tensordot(start_matrix, starts, 1) + jnp.tensordot(end_matrix, ends, 1), 0, 1
    )


def derivatives_at_breakpoints(
    values: Float[Array, "interval node *value"],
) -> Float[Array, "breakpoint order *value"]:
    """Values and first two derivatives at the start of each interval and at the last end.

    They are those of the polynomials through values at the Gauss nodes.
    """
    starts = jnp.einsum("rj,sj...->sr...", NODES_TO_ENDS[0], values)
    return jnp.concatenate(
        [starts, jnp.einsum("rj,j...->r...", NODES_TO_ENDS[1], values[-1])[None]]
    )


def _power_derivatives(
    position: float, orders: int, powers: int
) -> Float[np.ndarray, "order power"]:
    """Powers of a number, and their derivatives below an order."""
    exponents = np.arange(powers)
    factors = [np.prod([exponents - k for k in range(r)], axis=0) for r in range(orders)]
    remaining_exponents = [np.maximum(exponents - r, 0) for r in range(orders)]
    return np.stack(
        [factor * position**rest for factor, rest in zip(factors, remaining_exponents, strict=True)]
    )


def hermite_matrices(orders: int) -> tuple[Float[np.ndarray, "power order"], ...]:
    """Matrices from derivatives at 0, and from those at 1, to the Hermite polynomial."""
    rows = [_power_derivatives(at, orders, 2 * orders) for at in (0.0, 1.0)]
    inverse = np.linalg.inv(np.concatenate(rows))
    return inverse[:, :orders], inverse[:, orders:]


# (end, order, node): from values at the Gauss nodes to derivatives at both ends.
NODES_TO_ENDS = np.stack(
    [_power_derivatives(at, 3, GAUSS_NODES.size) for at in (0.0, 1.0)]
) @ np.linalg.inv(GAUSS_NODES[:, None] ** np.arange(GAUSS_NODES.size))
