"""Profiles that change between a start and an end, and are level before and behind."""

import abc
from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.fields import POSITIVE, concrete, is_concrete, number
from jaxbeam.case.profiles.averaged import AbstractAveragedProfile
from jaxbeam.runtime.arrays import Array, xp


class AbstractTransition(AbstractAveragedProfile):
    """Profile s = height f((x - start) / (end - start)), f = 0 before the start, f(1) behind."""

    shape_at_end: ClassVar[float]

    start: Float[Array, ""] = number("m", "position at which it begins")
    end: Float[Array, ""] = number("m", "position at which it ends")
    height: Float[Array, ""] = number("m", "height")
    contact_length: Float[Array, ""] | None = number(
        "m", "length of the contact patch over which a wheel averages", POSITIVE, default=None
    )

    @abc.abstractmethod
    def shape(self, u) -> tuple[Float[Array, "*x"], ...]:
        """Integral from 0, value, first and second derivative of f at u from 0 to 1."""

    def surface(self, x):
        length = self.end - self.start
        u = xp.clip((x - self.start) / length, 0.0, 1.0)
        inside = (x >= self.start) & (x < self.end)
        integral, value, slope, curvature = self.shape(u)
        beyond = self.shape_at_end * xp.maximum(x - self.end, 0.0)
        return (
            self.height * (length * integral + beyond),
            self.height * value,
            xp.where(inside, self.height / length * slope, 0.0),
            xp.where(inside, self.height / length**2 * curvature, 0.0),
        )

    def validate(self, address):
        if is_concrete(self.start) and is_concrete(self.end):
            start, end = concrete(self.start), concrete(self.end)
            if end <= start:
                return (
                    f"{address}.end must lie to the right of {address}.start; {end:g} m is not"
                    f" beyond {start:g} m"
                )
        return None
