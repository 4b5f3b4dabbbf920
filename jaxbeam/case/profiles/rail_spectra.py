"""Published power spectral densities of the vertical irregularity of tracks.

All are one-sided, by wavenumbers n in cycles per metre, S(n) in m^3. A density by radians per metre
has S(n) = 2 pi S(Omega = 2 pi n). Constants, wavelengths and their origins are as in the options of
TTB-2D (A04_Options.m; D. Cantero, SoftwareX 20, 2022, doi 10.1016/j.softx.2022.101253) where
nothing else is said.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple


class RailSpectrum(NamedTuple):
    """Density (m^3) by the wavenumber (cycles per metre), and the range of its wavelengths (m)."""

    density: Callable[[Any], Any]
    shortest_wavelength: float
    longest_wavelength: float


def _federal_railroad_administration(a: float) -> RailSpectrum:
    """S = A n2^2 (n^2 + n1^2) / (n^4 (n^2 + n2^2)), A in m.

    After L. Fryba, Dynamics of Railway Bridges, 1996. The other form in use, with 0.25 A_v and
    0.8245 rad/m, has several times its power for the same class.
    """
    n1, n2 = 0.0233, 0.131

    def density(n):
        return a * n2**2 * (n**2 + n1**2) / (n**4 * (n**2 + n2**2))

    return RailSpectrum(density, 1.524, 304.8)


def _german(a: float) -> RailSpectrum:
    """S(Omega) = A Omega_c^2 / ((Omega^2 + Omega_r^2) (Omega^2 + Omega_c^2)), A in m^2 rad/m.

    Low disturbance after W.W. Guo et al., Computers & Structures 112-113, 2012; without the factor
    (0.4 / 0.9843)^2 that TTB-2D has and does not explain. The constant of high disturbance is that
    of public programs of vehicle-bridge interaction, which give both constants as one-sided.
    """
    corner, roll_off = 0.8246, 0.0206  # rad/m

    def density(n):
        omega = 2 * math.pi * n
        shape = corner**2 / ((omega**2 + roll_off**2) * (omega**2 + corner**2))
        return 2 * math.pi * a * shape

    return RailSpectrum(density, 3.0, 150.0)


def _french(a: float) -> RailSpectrum:
    """S = A / (1 + n / n0)^3, A in m^3; after A.R.B. Berawi, doctoral thesis, Porto."""

    def density(n):
        return a / (1 + n / 0.0489) ** 3

    return RailSpectrum(density, 2.0, 40.0)


RAIL_SPECTRA = {
    "fra-1": _federal_railroad_administration(15.53e-8),  # worst
    "fra-2": _federal_railroad_administration(8.85e-8),
    "fra-3": _federal_railroad_administration(4.92e-8),
    "fra-4": _federal_railroad_administration(2.75e-8),
    "fra-5": _federal_railroad_administration(1.57e-8),
    "fra-6": _federal_railroad_administration(0.98e-8),  # best
    "german-low": _german(4.032e-7),
    "german-high": _german(1.080e-6),
    "sncf": _french(0.509 * 308e-6),  # good track
    "sncf-poor": _french(1.790 * 308e-6),
}
