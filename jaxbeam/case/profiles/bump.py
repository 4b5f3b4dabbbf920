"""Single bump or dip."""

from typing import ClassVar

import numpy as np

from jaxbeam.case.profiles.transition import AbstractTransition
from jaxbeam.runtime.arrays import xp


class BumpProfile(AbstractTransition):
    """Bump from `start` to `end` with its peak `height` in the middle; negative: a dip.

    A versine: r = height / 2 (1 - cos(2 pi u)), u = (x - start) / (end - start). r'' jumps at both
    ends, r' does not.

    >>> import jaxbeam as jb
    >>> profile = jb.BumpProfile(start=0.0, end=2.0, height=0.03)
    >>> heights, slopes, curvatures = profile.heights([0.5, 1.0])
    >>> print(heights.round(4))
    [0.015 0.03 ]
    """

    kind: ClassVar[str] = "bump"
    shape_at_end: ClassVar[float] = 0.0

    def shape(self, u):
        turn = 2 * np.pi
        sine, cosine = xp.sin(turn * u), xp.cos(turn * u)
        return (u - sine / turn) / 2, (1 - cosine) / 2, turn / 2 * sine, turn**2 / 2 * cosine

    def curvature_jumps(self):
        return xp.stack([self.start, self.end])
