"""Random track of a published spectrum."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, choice, count, number
from jaxbeam.case.profiles.rail_spectra import RAIL_SPECTRA
from jaxbeam.case.profiles.random_profile import AbstractRandomProfile
from jaxbeam.runtime.arrays import Array


class RailProfile(AbstractRandomProfile):
    """Track of a spectrum of `jaxbeam.case.profiles.rail_spectra`, which has the sources.

    "fra-1" (worst) to "fra-6" (best) of the Federal Railroad Administration, "german-low" and
    "german-high" disturbance, "sncf" (good track) and "sncf-poor". The wavelengths are those for
    which the spectrum was published, where none are given.

    >>> import jaxbeam as jb
    >>> profile = jb.RailProfile("fra-6", seed=1)
    >>> print(f"{profile.density(0.1):.2g} m^3")
    6.5e-07 m^3
    """

    kind: ClassVar[str] = "rail"

    spectrum: str = choice("spectrum of the track", *RAIL_SPECTRA)
    seed: int = count("seed of the phases", minimum=0, default=0)
    scale: Float[Array, ""] = number("1", "factor of the heights", NOT_NEGATIVE, default=1.0)
    shortest_wavelength: Float[Array, ""] | None = number(
        "m", "shortest wavelength", POSITIVE, default=None
    )
    longest_wavelength: Float[Array, ""] | None = number(
        "m", "longest wavelength", POSITIVE, default=None
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
        return RAIL_SPECTRA[self.spectrum].density(n)

    def wavenumber_range(self):
        published = RAIL_SPECTRA[self.spectrum]
        shortest, longest = self.shortest_wavelength, self.longest_wavelength
        shortest = published.shortest_wavelength if shortest is None else shortest
        longest = published.longest_wavelength if longest is None else longest
        return 1 / longest, 1 / shortest

    def _empty_range_error(self, address, lowest, highest):
        return (
            f"{address}.shortest_wavelength must be below {address}.longest_wavelength;"
            f" {1 / highest:g} m is not below {1 / lowest:g} m"
        )
