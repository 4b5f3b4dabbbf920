"""Profiles of given shapes: the interface, bumps, ramps, sines, steps, tables."""

import abc
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import INCREASING, POSITIVE, concrete, is_concrete, number
from jaxbeam.runtime.arrays import Array, Module, Number, set_at, solve_tridiagonal, take, xp

Heights = tuple[Float[Array, "*x"], Float[Array, "*x"], Float[Array, "*x"]]


class AbstractProfile(ReprWithUnits, Module):
    """Height r(x) (m, positive upwards) of the surface, before, on and behind the beam.

    A wheel at x that travels at v = x' and a = x'' rolls over the height y = w + r and feels

        y' = w_t + v w_x + v r',    y'' = w_tt + 2 v w_xt + v^2 w_xx + a w_x + v^2 r'' + a r'.

    To add a kind, write a file in `jaxbeam.case.profiles` with a subclass that declares its `kind`.
    """

    kind: ClassVar[str]

    @abc.abstractmethod
    def heights(self, x) -> Heights:
        """Height r (m), slope r' (1) and curvature r'' (1/m) at positions x (m) of any shape.

        Where r' or r'' jumps, they are those on the right.
        """

    def by_numbers(self) -> "AbstractProfile":
        """The same profile with its waves in place of static fields such as a seed.

        Profiles of equal structure use the same compiled programs.
        """
        return self

    def kinks(self) -> Float[Array, " kink"]:
        """Positions (m) at which r' or r'' jumps; their number depends on no number of the case."""
        return xp.zeros(0)

    def slope_kinks(self) -> tuple[Float[Array, " kink"], Float[Array, " kink"]]:
        """Positions (m) at which r' jumps, and the jumps of r' (1), from left to right.

        There the velocity of a wheel with mass and no tyre jumps, and the beam takes an impulse.
        """
        return xp.zeros(0), xp.zeros(0)

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        return None

    def validate_travel(self, address: str, start, end) -> str | None:
        """Error message if it is not defined over a travel from start to end (m), or None."""
        return None


class AbstractAveragedProfile(AbstractProfile):
    """Profile s(x) that a wheel feels as its mean over a contact patch of a length l (m):

        r(x) = (S(x + l/2) - S(x - l/2)) / l,    S' = s;

    without `contact_length`, r = s. The mean has no jump of slope: those of s become jumps of
    curvature at both edges of the patch.
    """

    contact_length: eqx.AbstractVar[Float[Array, ""] | None]

    @abc.abstractmethod
    def surface(self, x) -> tuple[Float[Array, "*x"], ...]:
        """Integral S (m^2), height s (m), slope s' (1), curvature s'' (1/m) at positions x (m)."""

    def slope_jumps(self) -> Float[Array, " kink"]:
        """Positions (m) at which s' jumps."""
        return xp.zeros(0)

    def sizes_of_slope_jumps(self) -> Float[Array, " kink"]:
        """Jumps of s' (1) at these positions, from left to right."""
        return xp.zeros(0)

    def curvature_jumps(self) -> Float[Array, " kink"]:
        """Positions (m) at which s'' jumps, though s' does not."""
        return xp.zeros(0)

    def heights(self, x):
        x = xp.asarray(x, float)
        if self.contact_length is None:
            _, height, slope, curvature = self.surface(x)
            return height, slope, curvature
        half = self.contact_length / 2
        pairs = zip(self.surface(x + half), self.surface(x - half), strict=True)
        height, slope, curvature, _ = ((a - b) / self.contact_length for a, b in pairs)
        return height, slope, curvature

    def kinks(self):
        jumps = self.slope_jumps()
        if self.contact_length is None:
            return xp.concatenate([jumps, self.curvature_jumps()])
        half = self.contact_length / 2
        return xp.concatenate([jumps - half, jumps + half])

    def slope_kinks(self):
        if self.contact_length is not None:
            return super().slope_kinks()
        return self.slope_jumps(), self.sizes_of_slope_jumps()


class AbstractTransition(AbstractAveragedProfile):
    """Profile s = height f((x - start) / (end - start)), f = 0 before the start, f(1) behind."""

    shape_at_end: ClassVar[float]

    start: Float[Number, ""] = number("m", "position at which it begins")
    end: Float[Number, ""] = number("m", "position at which it ends")
    height: Float[Number, ""] = number("m", "height")
    contact_length: Float[Number, ""] | None = number(
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


def smooth_step(u) -> tuple[Float[Array, "*x"], ...]:
    """Integral from 0, value, first and second derivative of u^3 (10 - 15 u + 6 u^2), u in [0, 1].

    The integral from 0 to 1 is 1/2.
    """
    integral = u**4 * (2.5 - 3 * u + u**2)
    value = u**3 * (10 - 15 * u + 6 * u**2)
    slope = 30 * u**2 * (1 - u) ** 2
    curvature = 60 * u * (1 - u) * (1 - 2 * u)
    return integral, value, slope, curvature


class BumpProfile(AbstractTransition):
    """Bump from `start` to `end` with its peak `height` in the middle; negative: a dip.

    A versine: r = height / 2 (1 - cos(2 pi u)), u = (x - start) / (end - start). r'' jumps at both
    ends, r' does not.

    >>> import jaxbeam as jb
    >>> profile = jb.profiles.BumpProfile(start=0.0, end=2.0, height=0.03)
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


class RampProfile(AbstractTransition):
    """Ramp that rises linearly by `height` from `start` to `end`, and stays there.

    r' jumps at both ends, by height / (end - start), unless a `contact_length` rounds them: the
    velocity of a wheel with mass that is rigidly on the surface jumps, by an impulse on the beam.

    >>> import jaxbeam as jb
    >>> profile = jb.profiles.RampProfile(start=0.0, end=2.0, height=0.03)
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


class SineProfile(AbstractProfile):
    """Waves r = amplitude sin(2 pi x / wavelength + phase), everywhere.

    The mean over a contact patch of a length l has sin(pi l / wavelength) / (pi l / wavelength)
    times the amplitude.

    >>> import jaxbeam as jb
    >>> profile = jb.profiles.SineProfile(amplitude=0.002, wavelength=4.0)
    >>> heights, slopes, curvatures = profile.heights([0.5, 1.0])
    >>> print(heights.round(4))
    [0.0014 0.002 ]
    """

    kind: ClassVar[str] = "sine"

    amplitude: Float[Number, ""] = number("m", "amplitude, half of the height from trough to crest")
    wavelength: Float[Number, ""] = number("m", "distance between crests", POSITIVE)
    phase: Float[Number, ""] = number("rad", "phase at x = 0", default=0.0)
    contact_length: Float[Number, ""] | None = number(
        "m", "length of the contact patch over which a wheel averages", POSITIVE, default=None
    )

    def heights(self, x):
        wavenumber = 2 * np.pi / self.wavelength
        amplitude = self.amplitude
        if self.contact_length is not None:
            amplitude = amplitude * xp.sinc(self.contact_length / self.wavelength)
        angle = wavenumber * xp.asarray(x, float) + self.phase
        height = amplitude * xp.sin(angle)
        return height, amplitude * wavenumber * xp.cos(angle), -(wavenumber**2) * height


class StepProfile(AbstractTransition):
    """Step that rises by `height` from `start` to `end`, and stays there: a quintic.

    r = height u^3 (10 - 15 u + 6 u^2), u = (x - start) / (end - start). r' and r'' do not jump.

    >>> import jaxbeam as jb
    >>> profile = jb.profiles.StepProfile(start=0.0, end=2.0, height=0.03)
    >>> heights, slopes, curvatures = profile.heights([0.5, 1.0, 3.0])
    >>> print(heights.round(4))
    [0.0031 0.015  0.03  ]
    """

    kind: ClassVar[str] = "step"
    shape_at_end: ClassVar[float] = 1.0

    def shape(self, u):
        return smooth_step(u)


class TableProfile(AbstractAveragedProfile):
    """Cubic spline through `heights` at `positions`, level before the first and behind the last.

    r' and r'' are continuous at the points. The slope is zero at the first and the last, where the
    level surface begins, so that r' jumps nowhere, as it would with ends that are free (natural
    spline) or follow the nearest points (not-a-knot); r'' jumps there. The ends bend only what is
    within a few points of them: let the table begin before the first wheel and end behind the
    last. Its points should be close enough to show the shortest wave.

    >>> import jaxbeam as jb
    >>> heights = [0.0, 0.01, 0.0]
    >>> profile = jb.profiles.TableProfile(positions=[0.0, 1.0, 2.0], point_heights=heights)
    >>> heights, slopes, curvatures = profile.heights([0.5, 1.0])
    >>> print(heights.round(4))
    [0.005 0.01 ]
    """

    kind: ClassVar[str] = "table"

    positions: Float[Number, " point"] = number("m", "positions along the beam", INCREASING)
    point_heights: Float[Number, " point"] = number("m", "heights at the positions")
    contact_length: Float[Number, ""] | None = number(
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
