"""Endless sine wave."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import POSITIVE, number
from jaxbeam.case.profiles.base import AbstractProfile
from jaxbeam.runtime.arrays import Array, xp


class SineProfile(AbstractProfile):
    """Waves r = amplitude sin(2 pi x / wavelength + phase), everywhere.

    The mean over a contact patch of a length l has sin(pi l / wavelength) / (pi l / wavelength)
    times the amplitude.

    >>> import jaxbeam as jb
    >>> profile = jb.SineProfile(amplitude=0.002, wavelength=4.0)
    >>> heights, slopes, curvatures = profile.heights([0.5, 1.0])
    >>> print(heights.round(4))
    [0.0014 0.002 ]
    """

    kind: ClassVar[str] = "sine"

    amplitude: Float[Array, ""] = number("m", "amplitude, half of the height from trough to crest")
    wavelength: Float[Array, ""] = number("m", "distance between crests", POSITIVE)
    phase: Float[Array, ""] = number("rad", "phase at x = 0", default=0.0)
    contact_length: Float[Array, ""] | None = number(
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
