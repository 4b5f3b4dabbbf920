"""Largest absolute value of a smooth curve known at a few equal points."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

FINE = 64  # places at which the interpolant is looked at before Newton's method takes over


def vertex(samples: Float[Array, "point *rest"]) -> Float[Array, " *rest"]:
    """Largest absolute value, closely estimated from at least five samples.

    Each sample is the middle of a parabola through its neighbours, corrected at its vertex by the
    third and fourth differences. Cheap, to tell which of many steps holds the peak; `refine` then
    finds it.
    """
    before, middle, after = samples[:-2], samples[1:-1], samples[2:]
    slope, bend = (after - before) / 2, after - 2 * middle + before
    inside = jnp.abs(slope) < jnp.abs(bend)
    way = jnp.where(inside, -slope / jnp.where(inside, bend, 1.0), 0.0)
    fourth = bend[2:] - 2 * bend[1:-1] + bend[:-2]
    third = (bend[2:] - bend[:-2]) / 2
    # The outermost stencils lend their differences to the samples beside them.
    third = jnp.concatenate([third[:1] - fourth[:1], third, third[-1:] + fourth[-1:]])
    fourth = jnp.concatenate([fourth[:1], fourth, fourth[-1:]])
    square = way**2 - 1
    top = middle + way * (slope / 2 + square * (third / 6 + way * fourth / 24))
    return jnp.maximum(jnp.max(jnp.abs(samples), axis=0), jnp.max(jnp.abs(top), axis=0))


def refine(samples: Float[Array, "point *rest"]) -> tuple[Float[Array, " *rest"], ...]:
    """Largest absolute value of the polynomial through the samples, and where in [0, 1] it is.

    The derivative is that at the fixed place of the peak, which is exact where the peak is a
    maximum inside the curve and where it is at an end that stays.
    """
    points = samples.shape[0]
    powers = np.arange(points)
    # The curve as a polynomial in 2 c - 1, where it is best conditioned.
    nodes = np.linspace(-1.0, 1.0, points)
    monomials = jnp.tensordot(np.linalg.inv(nodes[:, None] ** powers), samples, axes=1)
    frozen = jax.lax.stop_gradient(monomials)
    column = (-1,) + (1,) * (samples.ndim - 1)

    # Highest power first, as Horner's rule takes them.
    slope = jnp.flip(frozen[1:] * powers[1:].reshape(column), 0)
    bend = jnp.flip(frozen[2:] * (powers[2:] * powers[1:-1]).reshape(column), 0)
    curve = jnp.flip(frozen, 0)

    fine = np.linspace(-1.0, 1.0, FINE + 1)
    looked = jnp.tensordot(fine[:, None] ** powers, frozen, axes=1)
    start = jnp.asarray(fine)[jnp.argmax(jnp.abs(looked), axis=0)]

    def improve(_, place):
        steep = jnp.polyval(bend, place, unroll=1)
        flat = steep == 0
        step = jnp.polyval(slope, place, unroll=1) / jnp.where(flat, 1.0, steep)
        step = jnp.where(flat, 0.0, jnp.clip(step, -2 / FINE, 2 / FINE))
        return jnp.clip(place - step, -1.0, 1.0)

    place = jax.lax.fori_loop(0, 4, improve, start)
    # Where the curve is highest at an end, Newton's method may run away to a lower place.
    high, before = (jnp.abs(jnp.polyval(curve, at, unroll=1)) for at in (place, start))
    place = jax.lax.stop_gradient(jnp.where(high > before, place, start))
    value = jnp.polyval(jnp.flip(monomials, 0), place, unroll=1)
    return jnp.abs(value), (place + 1) / 2
