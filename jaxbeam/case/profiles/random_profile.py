"""Random profiles: realisations of a power spectral density."""

import abc
import functools

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.profiles.spectral import AbstractSpectralProfile
from jaxbeam.case.profiles.spectrum import SpectrumProfile
from jaxbeam.runtime.arrays import Array, xp


class AbstractRandomProfile(AbstractSpectralProfile):
    """Realisation of a one-sided power spectral density S(n) (m^3) over a range of wavenumbers n.

        r(x) = Q(x) scale sum_i sqrt(2 S(n_i) dn_i) cos(2 pi n_i x + phase_i)

    with n in cycles per metre, so that its variance is scale^2 times the integral of S. The phases,
    uniform from 0 to 2 pi, are `numpy.random.default_rng(seed)`'s: a seed is a profile, also after
    other numbers have changed. The bands dn_i are as many as `waves` and equally wide on a
    logarithmic scale, n_i in their geometric mean: long waves, which have most of the power, are as
    finely resolved as short ones, nothing repeats along the travel, and the power of a band of
    S ~ 1/n^2 is exact.
    """

    seed: eqx.AbstractVar[int]
    waves: eqx.AbstractVar[int]
    scale: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def density(self, n: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """One-sided power spectral density S (m^3) at wavenumbers n (cycles per metre)."""

    @abc.abstractmethod
    def wavenumber_range(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Lowest and highest wavenumber (cycles per metre)."""

    def lines(self):
        lowest, highest = self.wavenumber_range()
        edges = lowest * (highest / lowest) ** (np.arange(self.waves + 1) / self.waves)
        wavenumbers = xp.sqrt(edges[:-1] * edges[1:])
        amplitudes = self.scale * xp.sqrt(2 * self.density(wavenumbers) * xp.diff(edges))
        return wavenumbers, amplitudes, random_phases(self.seed, self.waves)

    def by_numbers(self):
        wavenumbers, amplitudes, phases = self.lines()
        return SpectrumProfile(wavenumbers, amplitudes, phases, self.switch_on, self.contact_length)

    def validate(self, address):
        lowest, highest = self.wavenumber_range()
        if is_concrete(lowest) and is_concrete(highest):
            low, high = concrete(lowest), concrete(highest)
            if not low < high:
                return self._empty_range_error(address, float(low), float(high))
        return super().validate(address)

    @abc.abstractmethod
    def _empty_range_error(self, address: str, lowest: float, highest: float) -> str:
        """Error message for a lowest wavenumber that is not below the highest one."""


@functools.lru_cache(maxsize=64)
def random_phases(seed: int, size: int) -> Float[np.ndarray, " line"]:
    """Phases (rad), uniform from 0 to 2 pi, of NumPy's default generator."""
    phases = np.random.default_rng(seed).uniform(0.0, 2 * np.pi, size)
    phases.setflags(write=False)
    return phases
