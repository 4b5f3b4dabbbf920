"""Largest value of a smooth curve known at a few points, absolute unless asked otherwise."""

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
CLIMBS = 3  # rounds of Newton's method from each, and once more from the best


class Curve(NamedTuple):
    """A polynomial in 2 c - 1 and its first two derivatives: coefficients, lowest power first."""

    value: list
    slope: list
    bend: list


@functools.cache
def through(points: tuple[float, ...]) -> np.ndarray:
    """Matrix from samples at points in [0, 1] to coefficients of their curve, slope and bend."""
    value = np.linalg.inv(_centred(points)[:, None] ** np.arange(len(points)))
    slope = np.polynomial.polynomial.polyder(value)
    return np.concatenate([value, slope, np.polynomial.polynomial.polyder(slope)])


def reach(points: tuple[float, ...]) -> float:
    """How far a step towards the peak may go in `vertex`: a few cross half of any gap."""
    return float(np.diff(_centred(points)).max()) / 3


def _centred(points: tuple[float, ...]) -> np.ndarray:
    return 2 * np.array(points) - 1


def _curve(samples: Float[Array, "point *rest"], points: tuple[float, ...]) -> Curve:
    count = len(points)
    rows = list(jnp.tensordot(through(points), samples, axes=1))
    return Curve(rows[:count], rows[count : 2 * count - 1], rows[2 * count - 1 :])


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
    samples: Float[Array, "point *rest"], points: tuple[float, ...], size: Callable = jnp.abs
) -> Float[Array, " *rest"]:
    """Largest size of a value, closely estimated: sought from the largest sample alone.

    Cheap, to tell which of many steps holds the peak; `refine` then finds it.
    """
    sizes = size(samples)
    largest = jnp.max(sizes, axis=0)
    start = jnp.asarray(_centred(points), samples.dtype)[jnp.argmax(sizes, axis=0)]
    curve = _curve(samples, points)
    place = _climb(curve, start, reach(points), rounds=VERTEX_ROUNDS)
    return jnp.maximum(size(_value(curve.value, place)), largest)


@jax.named_scope("peaks")
def find(
    samples: Float[Array, "point *rest"], points: tuple[float, ...], size: Callable = jnp.abs
) -> Float[Array, " *rest"]:
    """Where in [-1, 1] the polynomial through the samples has the largest size of a value."""
    curve = _curve(samples, points)
    # From everywhere, as peaks may tie; at an end Newton's method may run away to a lower place.
    starts = np.linspace(-1.0, 1.0, STARTS).reshape(-1, *(1,) * (samples.ndim - 1))
    starts = jnp.broadcast_to(starts.astype(samples.dtype), (STARTS, *samples.shape[1:]))
    places = jnp.concatenate([starts, _climb(curve, starts, 2 / STARTS, CLIMBS)])
    _, top = highest(size(_value(curve.value, places)))
    place = jnp.max(jnp.where(top, places, -1.0), axis=0)
    # The height is right by now to nearly rounding, the place to the root of that: further rounds
    # mend this, unless the peak is at an end and there is nothing flat nearby.
    flat = _climb(curve, place, 2 / STARTS, CLIMBS)
    _, ahead = highest(size(_value(curve.value, jnp.stack([flat, place]))))
    return jnp.where(ahead[0], flat, place)


def refine(
    samples: Float[Array, "point *rest"], points: tuple[float, ...], size: Callable = jnp.abs
) -> tuple[Float[Array, " *rest"], ...]:
    """Largest size of a value of the polynomial through the samples, and where in [0, 1] it is.

    `points` are where in [0, 1] the samples are, in order and with both ends. The derivative is
    that at the fixed place of the peak, which is exact where the peak is a maximum inside the curve
    and where it is at an end that stays.
    """
    place = find(jax.lax.stop_gradient(samples), points, size)
    place = jax.lax.optimization_barrier(jax.lax.stop_gradient(place))
    return size(_value(_curve(samples, points).value, place)), (place + 1) / 2
