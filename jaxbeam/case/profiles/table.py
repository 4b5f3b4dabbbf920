"""Measured or drawn surface: a smooth curve through heights at positions."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.fields import INCREASING, POSITIVE, concrete, is_concrete, number
from jaxbeam.case.profiles.averaged import AbstractAveragedProfile
from jaxbeam.runtime.arrays import Array, set_at, solve_tridiagonal, take, xp


class TableProfile(AbstractAveragedProfile):
    """Cubic spline through `heights` at `positions`, level before the first and behind the last.

    r' and r'' are continuous at the points. The slope is zero at the first and the last, where the
    level surface begins, so that r' jumps nowhere, as it would with ends that are free (natural
    spline) or follow the nearest points (not-a-knot); r'' jumps there. The ends bend only what is
    within a few points of them: let the table begin before the first wheel and end behind the
    last. Its points should be close enough to show the shortest wave.

    >>> import jaxbeam as jb
    >>> profile = jb.TableProfile(positions=[0.0, 1.0, 2.0], point_heights=[0.0, 0.01, 0.0])
    >>> heights, slopes, curvatures = profile.heights([0.5, 1.0])
    >>> print(heights.round(4))
    [0.005 0.01 ]
    """

    kind: ClassVar[str] = "table"

    positions: Float[Array, " point"] = number("m", "positions along the beam", INCREASING)
    point_heights: Float[Array, " point"] = number("m", "heights at the positions")
    contact_length: Float[Array, ""] | None = number(
        "m", "length of the contact patch over which a wheel averages", POSITIVE, default=None
    )

    def _slopes(self):
        """Slopes of the spline at its points, by continuity of r'' at the inner ones."""
        intervals = xp.diff(self.positions)
        stiffness = 1 / intervals
        rises = 3 * xp.diff(self.point_heights) * stiffness**2
        slopes = xp.zeros_like(self.point_heights)
        if intervals.shape[0] == 1:
            return slopes
        inner = solve_tridiagonal(
            stiffness[1:-1],
            2 * (stiffness[:-1] + stiffness[1:]),
            stiffness[1:-1],
            rises[:-1] + rises[1:],
        )
        return set_at(slopes, slice(1, -1), inner)

    def surface(self, x):
        points, heights, slopes = self.positions, self.point_heights, self._slopes()
        h = xp.diff(points)
        chords = xp.diff(heights) / h
        second = (3 * chords - 2 * slopes[:-1] - slopes[1:]) / h
        third = (slopes[:-1] + slopes[1:] - 2 * chords) / h**2
        cubics = xp.stack([heights[:-1], slopes[:-1], second, third])
        areas = h * _polynomial(cubics / xp.array([1.0, 2.0, 3.0, 4.0])[:, None], h)
        areas = xp.concatenate([xp.zeros(1), xp.cumsum(areas)])

        clipped = xp.clip(x, points[0], points[-1])
        i = xp.clip(xp.searchsorted(points, clipped, side="right") - 1, 0, h.shape[0] - 1)
        t = clipped - take(points, i)
        a, b, c, d = xp.moveaxis(take(cubics.T, i), -1, 0)
        inside = (x >= points[0]) & (x < points[-1])
        before = heights[0] * xp.minimum(x - points[0], 0.0)
        behind = heights[-1] * xp.maximum(x - points[-1], 0.0)
        return (
            take(areas, i) + t * _polynomial((a, b / 2, c / 3, d / 4), t) + before + behind,
            _polynomial((a, b, c, d), t),
            xp.where(inside, _polynomial((b, 2 * c, 3 * d), t), 0.0),
            xp.where(inside, 2 * c + 6 * d * t, 0.0),
        )

    def curvature_jumps(self):
        return xp.stack([self.positions[0], self.positions[-1]])

    def validate(self, address):
        points, heights = self.positions.shape[0], self.point_heights.shape[0]
        if points != heights:
            return (
                f"{address} has {points} positions and {heights} heights; a table needs one height"
                " for each position"
            )
        if points < 2:
            return f"{address}.positions needs at least two points; it has {points}"
        return None

    def validate_travel(self, address, start, end):
        numbers = (self.positions, self.point_heights, start, end)
        if not all(map(is_concrete, numbers)):
            return None
        positions, heights, start, end = map(concrete, numbers)
        within = (positions[0] > start, positions[-1] < end)
        for i, is_within, verb in ((0, within[0], "begins"), (-1, within[1], "ends")):
            if is_within and heights[i] != 0:
                return (
                    f"{address} {verb} at {positions[i]:g} m with a height of {heights[i]:g} m, but"
                    f" loads travel from {start:g} to {end:g} m: extend the table, or let it"
                    f" {verb[:-1]} at a height of 0"
                )
        return None


def _polynomial(coefficients, t):
    """Polynomial of ascending coefficients at t."""
    *lower, value = coefficients
    for coefficient in reversed(lower):
        value = coefficient + t * value
    return value
