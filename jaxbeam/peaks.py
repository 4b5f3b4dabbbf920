"""Largest value of a smooth curve known at a few equal points, absolute unless asked otherwise."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

STARTS = 17  # places from which a peak is sought: closer than the extrema of the curve can be


def _polynomial(samples: Float[Array, "point *rest"]) -> list:
    """Coefficients, lowest power first, of the polynomial in 2 c - 1 through equal samples."""
    points = samples.shape[0]
    nodes = np.linspace(-1.0, 1.0, points)
    return list(jnp.tensordot(np.linalg.inv(nodes[:, None] ** np.arange(points)), samples, axes=1))


def _differentiate(coefficients: list) -> list:
    return [power * c for power, c in enumerate(coefficients)][1:]


def _value(coefficients: list, place):
    """The polynomial at a place, by Horner's rule."""
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = coefficient + place * value
    return value


def _climb(curve: list, start, reach: float, rounds: int):
    """Where the curve is flat near the start, by rounds of Newton's method within reach."""
    slope = _differentiate(curve)
    bend = _differentiate(slope)

    def closer(_, place):
        steep = _value(bend, place)
        flat = steep == 0
        step = jnp.where(flat, 0.0, _value(slope, place) / jnp.where(flat, 1.0, steep))
        return jnp.clip(place - jnp.clip(step, -reach, reach), -1.0, 1.0)

    return jax.lax.fori_loop(0, rounds, closer, start)


def vertex(
    samples: Float[Array, "point *rest"], size: Callable = jnp.abs
) -> Float[Array, " *rest"]:
    """Largest size of a value, closely estimated: sought from the largest sample alone.

    Cheap, to tell which of many steps holds the peak; `refine` then finds it.
    """
    sizes = size(samples)
    highest = jnp.max(sizes, axis=0)
    start = jnp.linspace(-1.0, 1.0, sizes.shape[0])[jnp.argmax(sizes, axis=0)]
    curve = _polynomial(samples)
    place = _climb(curve, start, 1 / sizes.shape[0], rounds=2)
    return jnp.maximum(size(_value(curve, place)), highest)


@jax.named_scope("peaks")
def refine(
    samples: Float[Array, "point *rest"], size: Callable = jnp.abs
) -> tuple[Float[Array, " *rest"], ...]:
    """Largest size of a value of the polynomial through the samples, and where in [0, 1] it is.

    The derivative is that at the fixed place of the peak, which is exact where the peak is a
    maximum inside the curve and where it is at an end that stays.
    """
    curve = _polynomial(samples)
    frozen = [jax.lax.stop_gradient(coefficient) for coefficient in curve]
    # From everywhere, as peaks may tie; at an end Newton's method may run away to a lower place.
    starts = np.linspace(-1.0, 1.0, STARTS).reshape(-1, *(1,) * (samples.ndim - 1))
    starts = jnp.broadcast_to(starts.astype(samples.dtype), (STARTS, *samples.shape[1:]))
    places = jnp.concatenate([starts, _climb(frozen, starts, 2 / STARTS, rounds=5)])
    best = jnp.argmax(size(_value(frozen, places)), axis=0)
    place = jnp.take_along_axis(places, best[None], axis=0)[0]
    place = jax.lax.optimization_barrier(jax.lax.stop_gradient(place))
    return size(_value(curve, place)), (place + 1) / 2
