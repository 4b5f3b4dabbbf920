"""Tables of gains over a crossing: piecewise polynomials, and those of frozen plants.

The gain R^-1 B'P and its first two derivatives at a breakpoint follow from P and the Riccati
equation. The batch axis is the last.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.numerics.batched_linalg import hstack, matmul, transpose
from jaxbeam.numerics.matrices import InputWeight, Square
from jaxbeam.numerics.polynomials import powers
from jaxbeam.numerics.riccati import lqr
from jaxbeam.numerics.stages import GAUSS_NODES, ConstantPlant
from jaxbeam.runtime.arrays import Array, take, xp
from jaxbeam.runtime.module import Module

END_OFFSET = 1e-9  # of an interval: ends are evaluated so far inside, as the plant may jump there
ROUNDING = 1e-12  # of the time span, of fractions at breakpoints

# State matrix A and input matrix B at a time (s).
PlantMatrices = Callable[[Float[Array, ""]], tuple[Float[Array, "..."], Float[Array, "..."]]]


class GainTable(Module):
    """Gain as a function of the fraction, 0 to 1, of its time span."""

    breakpoints: Float[Array, " breakpoint"]
    coefficients: Float[Array, "interval power input state"]

    def __call__(self, fraction: Float[Array, ""]) -> Float[Array, "input state"]:
        """Gain at a fraction of the time span; held before 0 and after 1.

        At a breakpoint, where gains may jump, it is the gain after it, whatever the rounding.
        """
        i = xp.searchsorted(self.breakpoints, fraction + ROUNDING, side="right") - 1
        i = xp.clip(i, 0, self.coefficients.shape[0] - 1)
        start = take(self.breakpoints, i)
        length = take(self.breakpoints, i + 1) - start
        interval_fraction = (fraction - start) / xp.where(length > 0, length, 1.0)
        fractions = powers(xp.clip(interval_fraction, 0.0, 1.0), self.coefficients.shape[1])
        coefficients = take(self.coefficients, i)
        rows = coefficients.reshape(coefficients.shape[0], -1)
        return (fractions @ rows).reshape(coefficients.shape[1:])


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
    """Matrices that map derivatives at 0, and those at 1, to the Hermite polynomial."""
    rows = [_power_derivatives(at, orders, 2 * orders) for at in (0.0, 1.0)]
    inverse = np.linalg.inv(np.concatenate(rows))
    return inverse[:, :orders], inverse[:, orders:]


# (end, order, node): from values at the Gauss nodes to derivatives at both ends.
NODES_TO_ENDS = np.stack(
    [_power_derivatives(at, 3, GAUSS_NODES.size) for at in (0.0, 1.0)]
) @ np.linalg.inv(GAUSS_NODES[:, None] ** np.arange(GAUSS_NODES.size))


def interpolate_gains(
    plant: ConstantPlant,
    force_distribution: Float[Array, "interval node direction force _"],
    force_law: Float[Array, "interval node force state_and_input _"],
    costs: Float[Array, "breakpoint state state batch"],
    length: Float[Array, " _"],
    Q: Float[Array, "state state _"],
    R_inverse: Float[Array, "input input _"],
) -> Float[Array, "interval power input state batch"]:
    """Gain polynomials of degree 5 over intervals of one length (s), from P at their breakpoints.

    The plant is its constant part plus E F (law rows) (x, u), with F and law given at the Gauss
    nodes.
    """
    force_distribution, force_law = (
        derivatives_at_breakpoints(force_distribution),
        derivatives_at_breakpoints(force_law),
    )  # breakpoint, derivative, ...
    force_input = jax.vmap(jax.vmap(lambda part: matmul(plant.E, part)))(force_distribution)

    def at_breakpoint(force_input, force_law, cost):
        return _gain_and_derivatives(plant, force_input, force_law, cost, length, Q, R_inverse)

    gains = jax.vmap(at_breakpoint, out_axes=1)(force_input, force_law, costs)
    return hermite_polynomials(gains[:, :-1], gains[:, 1:])


def _gain_and_derivatives(plant, force_input, force_law, cost, length, Q, R_inverse):
    """Gain and its first two derivatives with respect to the fraction of the interval.

    The plant is A + W V and B + W D with the force input W = E F and the law rows V of the state, D
    of the command. P is never differentiated as a whole, only its products with a few columns.
    """
    states, inputs = plant.B.shape[:2]
    (W, W_1, W_2), (V, V_1, _), (D, D_1, D_2) = (
        force_input,
        force_law[:, :, :states],
        force_law[:, :, states:],
    )
    B, B_1 = plant.B + matmul(W, D), matmul(W_1, D) + matmul(W, D_1)
    B_2 = matmul(W_2, D) + 2 * matmul(W_1, D_1) + matmul(W, D_2)
    VB = matmul(V, B)
    AB, varying = matmul(plant.A, B) + matmul(W, VB), matmul(W_1, VB) + matmul(W, matmul(V_1, B))
    columns = hstack(B_1, AB)
    A_columns = matmul(plant.A, columns) + matmul(W, matmul(V, columns))
    rows = transpose(hstack(B, columns, AB, A_columns, varying, B_2))
    low_rows = rows[: 3 * inputs]
    rows_P = matmul(rows, cost)  # P is symmetric
    B_P, low_rows_P = rows_P[:inputs], rows_P[: 3 * inputs]
    A_rows_P = rows_P[3 * inputs : 6 * inputs]
    gain = matmul(R_inverse, B_P)
    PA = matmul(low_rows_P, plant.A) + matmul(matmul(low_rows_P, W), V)
    PBRBP = matmul(matmul(low_rows, transpose(B_P)), gain)
    cost_rates = length * (PBRBP - A_rows_P - PA - matmul(low_rows, Q))
    B_P_rate, B_1_P_rate, AB_P_rate = (cost_rates[k * inputs : (k + 1) * inputs] for k in range(3))
    gain_rate_rows = B_P_rate + rows_P[inputs : 2 * inputs]  # of B'P
    force_rows = matmul(B_P_rate, W) + matmul(B_P, W_1)
    PA = matmul(B_P_rate, plant.A) + matmul(force_rows, V) + matmul(matmul(B_P, W), V_1)
    mixed = matmul(matmul(low_rows[:inputs], transpose(gain)), gain_rate_rows)
    mixed = mixed + matmul(matmul(low_rows[:inputs], transpose(gain_rate_rows)), gain)
    cost_curvature = length * (mixed - AB_P_rate - rows_P[6 * inputs : 7 * inputs] - PA)
    gain_curvature_rows = rows_P[7 * inputs :] + 2 * B_1_P_rate + cost_curvature
    return jnp.stack(
        [gain, matmul(R_inverse, gain_rate_rows), matmul(R_inverse, gain_curvature_rows)]
    )
