"""Profiles of which the mean over a contact patch follows from their integral, exactly."""

import abc

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.profiles.base import AbstractProfile
from jaxbeam.runtime.arrays import Array, xp


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
