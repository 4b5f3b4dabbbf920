"""Profile of given waves."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.fields import POSITIVE, number
from jaxbeam.case.profiles.spectral import AbstractSpectralProfile
from jaxbeam.runtime.arrays import Array


class SpectrumProfile(AbstractSpectralProfile):
    """Sum r = sum_i A_i cos(2 pi n_i x + phase_i) of given waves, everywhere.

    With `switch_on` it grows from 0 between two positions.

    >>> import jaxbeam as jb
    >>> profile = jb.SpectrumProfile(
    ...     wavenumbers=[0.1, 0.5], amplitudes=[0.01, 0.002], phases=[0.0, 1.0]
    ... )
    >>> heights, slopes, curvatures = profile.heights([0.0, 5.0])
    >>> print(heights.round(4))
    [ 0.0111 -0.0111]
    """

    kind: ClassVar[str] = "spectrum"

    wavenumbers: Float[Array, " line"] = number("1/m", "wavenumbers, cycles per metre", POSITIVE)
    amplitudes: Float[Array, " line"] = number("m", "amplitudes")
    phases: Float[Array, " line"] = number("rad", "phases at x = 0")
    switch_on: Float[Array, "2"] | None = number(
        "m", "positions where the profile begins and where it is all there", default=None
    )
    contact_length: Float[Array, ""] | None = number(
        "m", "length of the contact patch over which a wheel averages", POSITIVE, default=None
    )

    def lines(self):
        return self.wavenumbers, self.amplitudes, self.phases

    def validate(self, address):
        size = self.wavenumbers.shape[0]
        for name in ("amplitudes", "phases"):
            other = getattr(self, name).shape[0]
            if other != size:
                return (
                    f"{address} has {size} wavenumbers and {other} {name}; a spectrum needs one of"
                    " each for every wave"
                )
        if size == 0:
            return f"{address}.wavenumbers needs at least one entry; it has none"
        return super().validate(address)
