"""Polynomials of optimal gains over a group of stretches of one length, in lanes.

A gain is known at the edges with its first two rates: P is, and with it, by the Riccati equation,
how it changes.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.numerics.batched_linalg import joined, times, turned
from jaxbeam.numerics.coupled_stages import Plant
from jaxbeam.numerics.gain_table import from_nodes, polynomials


def pieces(
    plant: Plant,
    shape: Float[Array, "stretch stage direction force _"],
    law: Float[Array, "stretch stage force both _"],
    costs: Float[Array, "edge state state lane"],
    length: Float[Array, " _"],
    Q: Float[Array, "state state _"],
    inverse: Float[Array, "input input _"],
) -> Float[Array, "stretch power input state lane"]:
    """Polynomials of the gain over a group of stretches, from P at its edges, in lanes.

    The rate of the state is that by the constant part of the `plant`, plus E shape law (x, u); what
    changes is known at the nodes, and wanted, with its rates, at the edges.
    """
    shape, law = from_nodes(shape), from_nodes(law)  # edge, rate, ...
    push = jax.vmap(jax.vmap(lambda part: times(plant.E, part)))(shape)

    def at_edge(push, law, cost):
        return _gains(plant, push, law, cost, length, Q, inverse)

    gains = jax.vmap(at_edge, out_axes=1)(push, law, costs)
    return polynomials(gains[:, :-1], gains[:, 1:])


def _gains(plant, push, law, cost, length, Q, inverse):
    """The gain, its rate and the rate of that, by share of a stretch.

    A = plant.A + push law_x and B = plant.B + push law_u, with rates. P is never differentiated as
    a whole, but only what it does to a few columns.
    """
    states, inputs = plant.B.shape[:2]
    (W, W_1, W_2), (V, V_1, _), (D, D_1, D_2) = push, law[:, :, :states], law[:, :, states:]
    B, B_1 = plant.B + times(W, D), times(W_1, D) + times(W, D_1)
    B_2 = times(W_2, D) + 2 * times(W_1, D_1) + times(W, D_2)
    seen = times(V, B)
    once, turn = times(plant.A, B) + times(W, seen), times(W_1, seen) + times(W, times(V_1, B))
    more = joined(B_1, once)
    twice = times(plant.A, more) + times(W, times(V, more))
    rows = turned(joined(B, more, once, twice, turn, B_2))
    few = rows[: 3 * inputs]
    held = times(rows, cost)  # P is symmetric
    seen, first, then = held[:inputs], held[: 3 * inputs], held[3 * inputs : 6 * inputs]
    onto = times(inverse, seen)
    back = times(first, plant.A) + times(times(first, W), V)
    spent = times(times(few, turned(seen)), onto)
    falls = length * (spent - then - back - times(few, Q))
    fall, rest, twice_fall = (falls[k * inputs : (k + 1) * inputs] for k in range(3))
    faster = fall + held[inputs : 2 * inputs]  # the rate of P B
    felt = times(fall, W) + times(seen, W_1)
    back = times(fall, plant.A) + times(felt, V) + times(times(seen, W), V_1)
    mixed = times(times(few[:inputs], turned(onto)), faster)
    mixed = mixed + times(times(few[:inputs], turned(faster)), onto)
    bends = length * (mixed - twice_fall - held[6 * inputs : 7 * inputs] - back)
    last = held[7 * inputs :] + 2 * rest + bends
    return jnp.stack([onto, times(inverse, faster), times(inverse, last)])
