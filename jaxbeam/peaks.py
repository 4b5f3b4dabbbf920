"""Largest value of a smooth curve known at a few equal points, absolute unless asked otherwise."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

VERTEX_ROUNDS = 2  # of Newton's method for a close estimate
ROUNDINGS = 8  # by which equal numbers may differ
STARTS = 17  # places from which a peak is sought: closer than the extrema of the curve can be


class Curve(NamedTuple):
    """A polynomial in 2 c - 1 and its first two derivatives: coefficients, lowest power first."""

    value: list
    slope: list
    bend: list


@functools.cache
def through(points: int) -> np.ndarray:
    """Matrix from equal samples to the coefficients of their curve, its slope and its bend."""
    nodes = np.linspace(-1.0, 1.0, points)
    value = np.linalg.inv(nodes[:, None] ** np.arange(points))
    slope = np.polynomial.polynomial.polyder(value)
    return np.concatenate([value, slope, np.polynomial.polynomial.polyder(slope)])


def _curve(samples: Float[Array, "point *rest"]) -> Curve:
    points = samples.shape[0]
    rows = list(jnp.tensordot(through(points), samples, axes=1))
    return Curve(rows[:points], rows[points : 2 * points - 1], rows[2 * points - 1 :])


def _value(coefficients: list, place):
    """The polynomial at a place, by Horner's rule."""
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = coefficient + place * value
    return value


def _climb(curve: Curve, start, reach: float, rounds: int):
    """Where the curve is flat near the start, by rounds of Newton's method within reach."""

    def closer(_, place):
        steep = _value(curve.bend, place)
        flat = steep == 0
        step = jnp.where(flat, 0.0, _value(curve.slope, place) / jnp.where(flat, 1.0, steep))
        return jnp.clip(place - jnp.clip(step, -reach, reach), -1.0, 1.0)

    return jax.lax.fori_loop(0, rounds, closer, start)


def highest(
    values: Float[Array, "some *rest"],
) -> tuple[Float[Array, " *rest"], Bool[Array, "some *rest"]]:
    """The highest of some values, and which of them are: quicker than `argmax`.

    Those that differ by rounding count, as XLA may compute what is compared here once for the
    maximum and once more, rounded otherwise, for the comparison.
    """
    top = jnp.max(values, axis=0)
    slack = ROUNDINGS * jnp.finfo(values.dtype).eps
    return top, values >= top - slack * jnp.abs(top)


def vertex(
    samples: Float[Array, "point *rest"], size: Callable = jnp.abs
) -> Float[Array, " *rest"]:
    """Largest size of a value, closely estimated: sought from the largest sample alone.

    Cheap, to tell which of many steps holds the peak; `refine` then finds it.
    """
    sizes = size(samples)
    largest = jnp.max(sizes, axis=0)
    start = jnp.linspace(-1.0, 1.0, sizes.shape[0])[jnp.argmax(sizes, axis=0)]
    curve = _curve(samples)
    place = _climb(curve, start, 1 / sizes.shape[0], rounds=VERTEX_ROUNDS)
    return jnp.maximum(size(_value(curve.value, place)), largest)


@jax.named_scope("peaks")
def refine(
    samples: Float[Array, "point *rest"], size: Callable = jnp.abs
) -> tuple[Float[Array, " *rest"], ...]:
    """Largest size of a value of the polynomial through the samples, and where in [0, 1] it is.

    The derivative is that at the fixed place of the peak, which is exact where the peak is a
    maximum inside the curve and where it is at an end that stays.
    """
    curve = _curve(samples)
    frozen = jax.lax.stop_gradient(curve)
    # From everywhere, as peaks may tie; at an end Newton's method may run away to a lower place.
    starts = np.linspace(-1.0, 1.0, STARTS).reshape(-1, *(1,) * (samples.ndim - 1))
    starts = jnp.broadcast_to(starts.astype(samples.dtype), (STARTS, *samples.shape[1:]))
    places = jnp.concatenate([starts, _climb(frozen, starts, 2 / STARTS, rounds=5)])
    _, top = highest(size(_value(frozen.value, places)))
    place = jnp.max(jnp.where(top, places, -1.0), axis=0)
    # Places of one height may lie apart by the root of a rounding: one round more brings them
    # together, unless the peak is at an end and there is nothing flat nearby.
    flat = _climb(frozen, place, 2 / STARTS, rounds=1)
    _, ahead = highest(size(_value(frozen.value, jnp.stack([flat, place]))))
    place = jnp.where(ahead[0], flat, place)
    place = jax.lax.optimization_barrier(jax.lax.stop_gradient(place))
    return size(_value(curve.value, place)), (place + 1) / 2
