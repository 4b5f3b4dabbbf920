"""Random road of a roughness class of ISO 8608."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, choice, count, number
from jaxbeam.case.profiles.random_profile import AbstractRandomProfile
from jaxbeam.runtime.arrays import Array

REFERENCE_WAVENUMBER = 0.1  # cycles per metre
ROAD_CLASSES = tuple("ABCDEFGH")


class ISO8608Profile(AbstractRandomProfile):
    """Road of a class of ISO 8608: S(n) = S(n0) (n / n0)^-2, n0 = 0.1 cycles per metre.

    S(n0) is the geometric mean of the limits of the class (ISO 8608:2016): 16e-6 m^3 for A, very
    good, and four times as much for each class after it. VBI-2D, for one, takes the middle of the
    limits, 20e-6 m^3 for A: `scale` = sqrt(20 / 16) is that. The default range, waves of 0.25 to
    100 m, is VBI-2D's. `class` is `road_class` in Python, where it is a reserved word.

    >>> import jaxbeam as jb
    >>> profile = jb.ISO8608Profile("A", seed=1)
    >>> print(f"{profile.density(0.1):.2g} m^3")
    1.6e-05 m^3
    """

    kind: ClassVar[str] = "iso8608"

    road_class: str = choice("roughness class", *ROAD_CLASSES)
    seed: int = count("seed of the phases", minimum=0, default=0)
    scale: Float[Array, ""] = number("1", "factor of the heights", NOT_NEGATIVE, default=1.0)
    lowest_wavenumber: Float[Array, ""] = number(
        "1/m", "lowest wavenumber, cycles per metre", POSITIVE, default=0.01
    )
    highest_wavenumber: Float[Array, ""] = number(
        "1/m", "highest wavenumber, cycles per metre", POSITIVE, default=4.0
    )
    waves: int = count("number of waves of the sum", default=100)
    switch_on: Float[Array, "2"] = number(
        "m",
        "positions where the profile begins and where it is all there",
        default=(-40.0, -30.0),
    )
    contact_length: Float[Array, ""] | None = number(
        "m", "length of the contact patch over which a wheel averages", POSITIVE, default=None
    )

    def density(self, n):
        mean = 16e-6 * 4.0 ** ROAD_CLASSES.index(self.road_class)
        return mean * (n / REFERENCE_WAVENUMBER) ** -2

    def wavenumber_range(self):
        return self.lowest_wavenumber, self.highest_wavenumber

    def _empty_range_error(self, address, lowest, highest):
        return (
            f"{address}.lowest_wavenumber must be below {address}.highest_wavenumber;"
            f" {lowest:g} 1/m is not below {highest:g} 1/m"
        )
