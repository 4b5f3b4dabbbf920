"""Smooth step from one level to another."""

from typing import ClassVar

from jaxbeam.case.profiles.smooth_step import smooth_step
from jaxbeam.case.profiles.transition import AbstractTransition


class StepProfile(AbstractTransition):
    """Step that rises by `height` from `start` to `end`, and stays there: a quintic.

    r = height u^3 (10 - 15 u + 6 u^2), u = (x - start) / (end - start). r' and r'' do not jump.

    >>> import jaxbeam as jb
    >>> profile = jb.StepProfile(start=0.0, end=2.0, height=0.03)
    >>> heights, slopes, curvatures = profile.heights([0.5, 1.0, 3.0])
    >>> print(heights.round(4))
    [0.0031 0.015  0.03  ]
    """

    kind: ClassVar[str] = "step"
    shape_at_end: ClassVar[float] = 1.0

    def shape(self, u):
        return smooth_step(u)
