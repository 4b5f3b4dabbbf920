"""Linear ramp from one level to another."""

from typing import ClassVar

from jaxbeam.case.profiles.transition import AbstractTransition
from jaxbeam.runtime.arrays import xp


class RampProfile(AbstractTransition):
    """Ramp that rises linearly by `height` from `start` to `end`, and stays there.

    r' jumps at both ends, by height / (end - start), unless a `contact_length` rounds them: the
    velocity of a wheel with mass that is rigidly on the surface jumps, by an impulse on the beam.

    >>> import jaxbeam as jb
    >>> profile = jb.RampProfile(start=0.0, end=2.0, height=0.03)
    >>> heights, slopes, curvatures = profile.heights([0.5, 1.0, 3.0])
    >>> print(heights.round(4))
    [0.0075 0.015  0.03  ]
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
