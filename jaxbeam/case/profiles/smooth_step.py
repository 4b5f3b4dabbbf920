"""Quintic from 0 to 1 whose slope and curvature are zero at both ends."""

from jaxtyping import Float

from jaxbeam.runtime.arrays import Array


def smooth_step(u) -> tuple[Float[Array, "*x"], ...]:
    """Integral from 0, value, first and second derivative of u^3 (10 - 15 u + 6 u^2), u in [0, 1].

    The integral from 0 to 1 is 1/2.
    """
    integral = u**4 * (2.5 - 3 * u + u**2)
    value = u**3 * (10 - 15 * u + 6 * u**2)
    slope = 30 * u**2 * (1 - u) ** 2
    curvature = 60 * u * (1 - u) * (1 - 2 * u)
    return integral, value, slope, curvature
