"""Linear ramp from one level to another."""

from typing import ClassVar

from jaxbeam.case.profiles.transition import AbstractTransition
from jaxbeam.runtime.arrays import xp


class RampProfile(AbstractTransition):
    """Ramp that rises linearly by `height` from `start` to `end`, and stays there.

    r' jumps at both ends, by height / (end - start), unless a `contact_length` rounds them: the
    velocity of a wheel with mass that is rigidly on the surface jumps, by an impulse on the beam.
    """

    kind: ClassVar[str] = "ramp"
    shape_at_end: ClassVar[float] = 1.0

    def shape(self, u):
        return u**2 / 2, u, xp.ones_like(u), xp.zeros_like(u)

    def slope_jumps(self):
        return xp.stack([self.start, self.end])

    def sizes_of_slope_jumps(self):
        slope = self.height / (self.end - self.start)
        return xp.stack([slope, -slope])
