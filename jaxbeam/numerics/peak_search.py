"""Largest value of a smooth curve known at a few points, absolute unless asked otherwise."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

ESTIMATE_ITERATIONS = 2  # of Newton's method for a close estimate
TIE_ROUNDING_UNITS = 8  # by which equal numbers may differ
START_POINTS = 17  # places from which a peak is sought: closer than the extrema of the curve can be
NEWTON_ITERATIONS = 3  # rounds of Newton's method from each, and once more from the best


class Curve(NamedTuple):
    """A polynomial in 2 c - 1 and its first two derivatives: coefficients, lowest power first."""

    value: list
    slope: list
    curvature: list


@functools.cache
def interpolation_matrix(points: tuple[float, ...]) -> np.ndarray:
    """Matrix from samples at points in [0, 1] to coefficients of their curve, slope and bend."""
    value = np.linalg.inv(_to_unit_interval(points)[:, None] ** np.arange(len(points)))
    slope = np.polynomial.polynomial.polyder(value)
    return np.concatenate([value, slope, np.polynomial.polynomial.polyder(slope)])


def newton_step_limit(points: tuple[float, ...]) -> float:
    """How far a step towards the peak may go in `estimate_peak`: a few cross half of any gap."""
    return float(np.diff(_to_unit_interval(points)).max()) / 3


def _to_unit_interval(points: tuple[float, ...]) -> np.ndarray:
    return 2 * np.array(points) - 1


def _interpolate(samples: Float[Array, "point *rest"], points: tuple[float, ...]) -> Curve:
    count = len(points)
    rows = list(jnp.tensordot(interpolation_matrix(points), samples, axes=1))
    return Curve(rows[:count], rows[count : 2 * count - 1], rows[2 * count - 1 :])


def _horner(coefficients: list, position):
    """The polynomial at a place, by Horner's rule."""
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = coefficient + position * value
    return value


def _newton_stationary_point(curve: Curve, start, step_limit: float, iterations: int):
    """Where the curve is flat near the start, by rounds of Newton's method within reach."""

    def newton_step(_, position):
        second_derivative = _horner(curve.curvature, position)
        singular = second_derivative == 0
        step = jnp.where(
            singular,
            0.0,
            _horner(curve.slope, position) / jnp.where(singular, 1.0, second_derivative),
        )
        return jnp.clip(position - jnp.clip(step, -step_limit, step_limit), -1.0, 1.0)

    return jax.lax.fori_loop(0, iterations, newton_step, start)


def max_with_ties(
    values: Float[Array, "some *rest"],
) -> tuple[Float[Array, " *rest"], Bool[Array, "some *rest"]]:
    """The highest of some values, and which of them are: quicker than `argmax`.

    Those that differ by rounding count, as XLA may compute what is compared here once for the
    maximum and once more, rounded otherwise, for the comparison.
    """
    maximum = jnp.max(values, axis=0)
    tolerance = TIE_ROUNDING_UNITS * jnp.finfo(values.dtype).eps
    return maximum, values >= maximum - tolerance * jnp.abs(maximum)


def estimate_peak(
    samples: Float[Array, "point *rest"], points: tuple[float, ...], magnitude: Callable = jnp.abs
) -> Float[Array, " *rest"]:
    """Largest size of a value, closely estimated: sought from the largest sample alone.

    Cheap, to tell which of many steps holds the peak; `refine_peak` then finds it.
    """
    magnitudes = magnitude(samples)
    largest = jnp.max(magnitudes, axis=0)
    start = jnp.asarray(_to_unit_interval(points), samples.dtype)[jnp.argmax(magnitudes, axis=0)]
    curve = _interpolate(samples, points)
    position = _newton_stationary_point(
        curve, start, newton_step_limit(points), iterations=ESTIMATE_ITERATIONS
    )
    return jnp.maximum(magnitude(_horner(curve.value, position)), largest)


@jax.named_scope("peaks")
def locate_peak(
    samples: Float[Array, "point *rest"], points: tuple[float, ...], magnitude: Callable = jnp.abs
) -> Float[Array, " *rest"]:
    """Where in [-1, 1] the polynomial through the samples has the largest size of a value."""
    curve = _interpolate(samples, points)
    # From everywhere, as peaks may tie; at an end Newton's method may run away to a lower place.
    starts = np.linspace(-1.0, 1.0, START_POINTS).reshape(-1, *(1,) * (samples.ndim - 1))
    starts = jnp.broadcast_to(starts.astype(samples.dtype), (START_POINTS, *samples.shape[1:]))
    positions = jnp.concatenate(
        [starts, _newton_stationary_point(curve, starts, 2 / START_POINTS, NEWTON_ITERATIONS)]
    )
    _, ties = max_with_ties(magnitude(_horner(curve.value, positions)))
    position = jnp.max(jnp.where(ties, positions, -1.0), axis=0)
    # The height is right by now to nearly rounding, the place to the root of that: further rounds
    # mend this, unless the peak is at an end and there is nothing flat nearby.
    stationary_point = _newton_stationary_point(
        curve, position, 2 / START_POINTS, NEWTON_ITERATIONS
    )
    _, ties_of_two = max_with_ties(
        magnitude(_horner(curve.value, jnp.stack([stationary_point, position])))
    )
    return jnp.where(ties_of_two[0], stationary_point, position)


def refine_peak(
    samples: Float[Array, "point *rest"], points: tuple[float, ...], magnitude: Callable = jnp.abs
) -> tuple[Float[Array, " *rest"], ...]:
    """Largest size of a value of the polynomial through the samples, and where in [0, 1] it is.

    `points` are where in [0, 1] the samples are, in order and with both ends. The derivative is
    that at the fixed place of the peak, which is exact where the peak is a maximum inside the curve
    and where it is at an end that stays.
    """
    position = locate_peak(jax.lax.stop_gradient(samples), points, magnitude)
    position = jax.lax.optimization_barrier(jax.lax.stop_gradient(position))
    return magnitude(_horner(_interpolate(samples, points).value, position)), (position + 1) / 2
