"""Polynomials of optimal gains over a group of stretches of one length, in lanes.

A gain is known at the edges with its first two rates: P is, and with it, by the Riccati equation,
how it changes.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.numerics.batched_linalg import hstack, matmul, transpose
from jaxbeam.numerics.coupled_stages import ConstantPlant
from jaxbeam.numerics.gain_table import derivatives_at_breakpoints, hermite_polynomials


def interpolate_gains(
    plant: ConstantPlant,
    force_distribution: Float[Array, "stretch stage direction force _"],
    force_law: Float[Array, "stretch stage force both _"],
    costs: Float[Array, "edge state state lane"],
    length: Float[Array, " _"],
    Q: Float[Array, "state state _"],
    R_inverse: Float[Array, "input input _"],
) -> Float[Array, "stretch power input state lane"]:
    """Polynomials of the gain over a group of stretches, from P at its edges, in lanes.

    The rate of the state is that by the constant part of the `plant`, plus E shape law (x, u); what
    changes is known at the nodes, and wanted, with its rates, at the edges.
    """
    force_distribution, force_law = (
        derivatives_at_breakpoints(force_distribution),
        derivatives_at_breakpoints(force_law),
    )  # edge, rate, ...
    force_input = jax.vmap(jax.vmap(lambda part: matmul(plant.E, part)))(force_distribution)

    def at_breakpoint(force_input, force_law, cost):
        return _gain_and_derivatives(plant, force_input, force_law, cost, length, Q, R_inverse)

    gains = jax.vmap(at_breakpoint, out_axes=1)(force_input, force_law, costs)
    return hermite_polynomials(gains[:, :-1], gains[:, 1:])


def _gain_and_derivatives(plant, force_input, force_law, cost, length, Q, R_inverse):
    """The gain, its rate and the rate of that, by share of a stretch.

    A = plant.A + push law_x and B = plant.B + push law_u, with rates. P is never differentiated as
    a whole, but only what it does to a few columns.
    """
    states, inputs = plant.B.shape[:2]
    (W, W_1, W_2), (V, V_1, _), (D, D_1, D_2) = (
        force_input,
        force_law[:, :, :states],
        force_law[:, :, states:],
    )
    B, B_1 = plant.B + matmul(W, D), matmul(W_1, D) + matmul(W, D_1)
    B_2 = matmul(W_2, D) + 2 * matmul(W_1, D_1) + matmul(W, D_2)
    B_P = matmul(V, B)
    once, turn = matmul(plant.A, B) + matmul(W, B_P), matmul(W_1, B_P) + matmul(W, matmul(V_1, B))
    more = hstack(B_1, once)
    twice = matmul(plant.A, more) + matmul(W, matmul(V, more))
    rows = transpose(hstack(B, more, once, twice, turn, B_2))
    low_rows = rows[: 3 * inputs]
    rows_P = matmul(rows, cost)  # P is symmetric
    B_P, first, then = rows_P[:inputs], rows_P[: 3 * inputs], rows_P[3 * inputs : 6 * inputs]
    gain = matmul(R_inverse, B_P)
    PA = matmul(first, plant.A) + matmul(matmul(first, W), V)
    PBRBP = matmul(matmul(low_rows, transpose(B_P)), gain)
    cost_rates = length * (PBRBP - then - PA - matmul(low_rows, Q))
    B_P_rate, rest, twice_fall = (cost_rates[k * inputs : (k + 1) * inputs] for k in range(3))
    gain_rate_rows = B_P_rate + rows_P[inputs : 2 * inputs]  # the rate of P B
    force_rows = matmul(B_P_rate, W) + matmul(B_P, W_1)
    PA = matmul(B_P_rate, plant.A) + matmul(force_rows, V) + matmul(matmul(B_P, W), V_1)
    mixed = matmul(matmul(low_rows[:inputs], transpose(gain)), gain_rate_rows)
    mixed = mixed + matmul(matmul(low_rows[:inputs], transpose(gain_rate_rows)), gain)
    cost_curvature = length * (mixed - twice_fall - rows_P[6 * inputs : 7 * inputs] - PA)
    gain_curvature_rows = rows_P[7 * inputs :] + 2 * rest + cost_curvature
    return jnp.stack(
        [gain, matmul(R_inverse, gain_rate_rows), matmul(R_inverse, gain_curvature_rows)]
    )
