"""Gain polynomials over a group of intervals, from cost-to-go matrices P at their breakpoints.

The gain R^-1 B'P and its first two derivatives at a breakpoint follow from P and the Riccati
equation. The batch axis is the last.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxbeam.numerics.batched_linalg import hstack, matmul, transpose
from jaxbeam.numerics.coupled_stages import ConstantPlant
from jaxbeam.numerics.gain_table import derivatives_at_breakpoints, hermite_polynomials
from jaxbeam.runtime.arrays import Array


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
    """Gain and its first two derivatives by the fraction of the interval.

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
