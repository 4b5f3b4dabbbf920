"""Interface of surface profiles: height of the road or track above the axis of the beam."""

import abc
from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.display.parts import ReprWithUnits
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.module import Module

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
        """The same profile with numbers in place of what is static, as a seed.

        Profiles of equal structure share compiled programs.
        """
        return self

    def kinks(self) -> Float[Array, " kink"]:
        """Positions (m) at which r' or r'' jumps; their number depends on no number of the case."""
        return xp.zeros(0)

    def slope_kinks(self) -> tuple[Float[Array, " kink"], Float[Array, " kink"]]:
        """Those of the `kinks` (m) at which r' jumps, and by how much (1), from left to right.

        There the velocity of a wheel with mass and no tyre jumps, and the beam takes an impulse.
        """
        return xp.zeros(0), xp.zeros(0)

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        return None

    def validate_travel(self, address: str, start, end) -> str | None:
        """Error message if it is not known over a travel from start to end (m), or None."""
        return None
