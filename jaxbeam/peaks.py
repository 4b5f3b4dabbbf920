"""Largest absolute value of a smooth curve known at a few equal points."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

FINE = 64  # places at which the interpolant is looked at before Newton's method takes over


@functools.cache
def _derivatives(points: int) -> np.ndarray:
    """Matrices (order, point, point): first to fourth derivative of the polynomial at its points.

    With respect to the distance of the points, so that their spacing is one.
    """
    places = np.arange(points) - (points - 1) / 2
    powers = np.arange(points)
    monomials = np.linalg.inv(places[:, None] ** powers)
    matrices = []
    for _ in range(4):
        monomials = np.concatenate([monomials[1:] * powers[1:, None], np.zeros((1, points))])
        matrices.append((places[:, None] ** powers) @ monomials)
    return np.array(matrices)


def vertex(samples: Float[Array, "point *rest"]) -> Float[Array, " *rest"]:
    """Largest absolute value, closely estimated from at least five samples.

    Every sample seeks the top of the curve near it, by two steps of Newton's method on its Taylor
    series to the fourth order. Cheap, to tell which of many steps holds the peak; `refine` then
    finds it.
    """
    points = samples.shape[0]
    slope, bend, third, fourth = jnp.tensordot(_derivatives(points), samples, axes=1)
    # Each looks halfway to the next, where the series is at its best, and not beyond the ends.
    reach = np.full((points,) + (1,) * (samples.ndim - 1), 0.55)
    least, most = -reach, reach.copy()
    least[0] = most[-1] = 0.0

    def newton(way, slope, bend):
        flat = bend == 0
        step = jnp.where(flat, 0.0, -slope / jnp.where(flat, 1.0, bend))
        return jnp.clip(way + step, least, most)

    way = newton(0.0, slope, bend)
    way = newton(
        way,
        slope + way * (bend + way * (third / 2 + way * fourth / 6)),
        bend + way * (third + way * fourth / 2),
    )
    top = samples + way * (slope + way / 2 * (bend + way / 3 * (third + way / 4 * fourth)))
    return jnp.max(jnp.maximum(jnp.abs(samples), jnp.abs(top)), axis=0)


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
