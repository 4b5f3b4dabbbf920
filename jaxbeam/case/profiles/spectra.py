"""Random profiles by their spectra: roads of ISO 8608, rails, and tables of spectra.

All are one-sided, by wavenumbers n in cycles per metre, S(n) in m^3. A density by radians per metre
has S(n) = 2 pi S(Omega = 2 pi n). Constants, wavelengths and their origins are as in the options of
TTB-2D (A04_Options.m; D. Cantero, SoftwareX 20, 2022, doi 10.1016/j.softx.2022.101253) where
nothing else is said.
"""

import abc
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, choice, concrete, count, is_concrete, number
from jaxbeam.case.profiles.shapes import (
    AbstractProfile,
    Heights,
    smooth_step,
)
from jaxbeam.runtime.arrays import Array, Module, Number, checkpoint, is_numpy, scan, xp, zeros

DIRECT_SIZE = 100_000  # cosines that are computed at once; more than these wave by wave
BLOCK = 16  # waves computed together then: memory does not grow with their number
# With concrete numbers the sum is interpolated on panels of PANEL_PHASE rad of its shortest wave,
# at PANEL_POINTS Chebyshev points each: their series of a cosine ends at J_24(4) = 2e-17.
PANEL_PHASE, PANEL_POINTS = 8.0, 24
PANELS_AT_ONCE = 64  # a call for each panel takes longer than its sum
LEAST_INTERPOLATED, LEAST_POSITIONS = 50_000, 4  # cosines in all, positions in a panel


class AbstractSpectralProfile(AbstractProfile):
    """Sum r = Q(x) sum_i A_i cos(2 pi n_i x + phase_i), with or without a switch Q from 0 to 1.

    Q is a quintic between the two positions `switch_on` (m), so that a wheel begins on a level
    surface: r = 0 before the first, the whole sum behind the second. The second is the smaller one
    for loads that travel left. The mean over a contact patch of a length l multiplies each
    amplitude by sin(pi n l) / (pi n l); Q is a factor of the mean.
    """

    switch_on: eqx.AbstractVar[Float[Array, "2"] | None]
    contact_length: eqx.AbstractVar[Float[Array, ""] | None]

    @abc.abstractmethod
    def lines(self) -> tuple[Float[Array, " line"], Float[Array, " line"], Float[Array, " line"]]:
        """Wavenumbers n (cycles per metre), amplitudes A (m), phases at x = 0 (rad).

        The amplitudes are those of the surface, before the mean over a contact patch.
        """

    def heights(self, x):
        x = xp.asarray(x, float)
        wavenumbers, _, phases = self.lines()
        heights = sum_of_cosines(x, wavenumbers, self.averaged_amplitudes(), phases)
        return heights if self.switch_on is None else _switched(x, self.switch_on, heights)

    def averaged_amplitudes(self) -> Float[Array, " line"]:
        """Amplitudes (m) of what a wheel feels, the mean over its contact patch."""
        wavenumbers, amplitudes, _ = self.lines()
        if self.contact_length is None:
            return amplitudes
        return amplitudes * xp.sinc(wavenumbers * self.contact_length)

    def validate(self, address):
        if self.switch_on is None or not is_concrete(self.switch_on):
            return None
        start, end = concrete(self.switch_on)
        if start == end:
            return (
                f"{address}.switch_on needs two different positions, of which the first wheel"
                f" passes the first one first; both are {start:g} m"
            )
        return None


def sum_of_cosines(
    x: Float[Array, "*x"],
    wavenumbers: Float[Array, " line"],
    amplitudes: Float[Array, " line"],
    phases: Float[Array, " line"],
) -> Heights:
    """Sum of amplitude cos(2 pi n x + phase) at positions x (m), with n in cycles per metre.

    Returns it (m) with its first (1) and second derivatives (1/m).
    """
    waves = (wavenumbers, amplitudes, phases)
    count = wavenumbers.shape[0]
    if x.size * count >= LEAST_INTERPOLATED and all(map(is_numpy, (x, *waves))):
        half = 0.5 * PANEL_PHASE / (2 * np.pi * np.max(np.abs(wavenumbers)))
        with np.errstate(all="ignore"):  # of positions that are not finite
            panels = np.ptp(x) / (2 * half)
        if LEAST_POSITIONS * (1 + panels) <= x.size:
            return _interpolated_sum(x, waves, half)
    if x.size * count <= DIRECT_SIZE:
        return _sum_at_once(x, *waves)
    padding = np.zeros(-count % BLOCK)
    blocks = tuple(xp.concatenate([wave, padding]).reshape(-1, BLOCK) for wave in waves)
    sum_of_block = checkpoint(_sum_at_once, jax.checkpoint_policies.nothing_saveable)

    def add_block(total, block):
        parts = zip(total, sum_of_block(x, *block), strict=True)
        return tuple(a + b for a, b in parts), None

    nothing = zeros(x.shape, (x, blocks))
    return scan(add_block, (nothing, nothing, nothing), blocks)[0]


def _sum_at_once(x, wavenumbers, amplitudes, phases) -> Heights:
    """`sum_of_cosines` by one array of cosines (position, wave)."""
    k = 2 * np.pi * wavenumbers
    angles = x[..., None] * k + phases
    even = xp.cos(angles) @ xp.stack([amplitudes, -amplitudes * k**2], axis=1)
    return even[..., 0], xp.sin(angles) @ (-amplitudes * k), even[..., 1]


def _interpolated_sum(x: np.ndarray, waves, half: float) -> Heights:
    """`sum_of_cosines` at many concrete positions, interpolated on panels of a `half` length (m).

    The waves at the Chebyshev points of all panels are products of those at their centres and of
    those at the points of one: few cosines, and products of matrices. Amplitudes and phases of
    several runs (run, line) give a last axis of runs.
    """
    wavenumbers, amplitudes, phases = waves
    k, first = 2 * np.pi * wavenumbers, np.min(x)
    flat, runs = np.ravel(x), phases.shape[:-1]
    panel = ((flat - first) / (2 * half)).astype(np.int32)
    used, counts = np.unique(panel, return_counts=True)
    centres = first + half * (2 * used + 1)
    at_centres = np.exp(1j * np.outer(centres, k))
    points = chebyshev.chebpts1(PANEL_POINTS)
    at_points = np.exp(1j * half * np.outer(k, points))
    # A real part is a product of two real matrices: of cosines and sines, side by side.
    parts = np.concatenate([at_centres.real, at_centres.imag], axis=1)
    to_series = np.where(np.arange(PANEL_POINTS) == 0, 1.0, 2.0)[:, None] / PANEL_POINTS
    to_series = (to_series * chebyshev.chebvander(points, PANEL_POINTS - 1).T).T
    series = np.empty((used.size, PANEL_POINTS, 3, math.prod(runs)))
    complex_amplitudes = (amplitudes * np.exp(1j * phases)).reshape(-1, k.size)
    for run, of_run in enumerate(complex_amplitudes):
        for i, factor in enumerate((1.0, 1j * k, -(k**2))):
            of_waves = (of_run * factor)[:, None] * at_points
            rows = np.concatenate([of_waves.real, -of_waves.imag]) @ to_series
            series[:, :, i, run] = parts @ rows
    series = series.reshape(used.size, PANEL_POINTS, -1)
    order = np.argsort(panel, kind="stable")  # positions of each panel, one panel after the other
    inside = (flat[order] - np.repeat(centres, counts)) / half
    found = np.empty((x.size, series.shape[2]))
    ends = np.cumsum(counts)
    for block in range(0, used.size, PANELS_AT_ONCE):
        own = ends[block : block + PANELS_AT_ONCE]
        places = np.s_[ends[block] - counts[block] : own[-1]]
        table = chebyshev.chebvander(inside[places], PANEL_POINTS - 1)
        parts = (np.split(part, own[:-1] - places.start) for part in (order[places], table))
        for one, here, rows in zip(series[block : block + own.size], *parts, strict=True):
            found[here] = rows @ one
    parts = found.reshape(*x.shape, 3, *runs)
    height, slope, curvature = np.moveaxis(parts, x.ndim, 0)
    return height, slope, curvature


def _switched(x, switch_on, heights) -> Heights:
    """Product of a profile and the quintic from 0 to 1 between two positions.

    Concrete heights may have a last axis of runs.
    """
    length = switch_on[1] - switch_on[0]
    if is_numpy(x) and is_numpy(switch_on) and all(map(is_numpy, heights)):
        before = (x - switch_on[0]) / length < 1.0  # elsewhere the factor is 1
        if x.ndim and not before.all():
            own = x[before].reshape(-1, *(1,) * (heights[0].ndim - x.ndim))
            parts = _switched(own, switch_on, tuple(part[before] for part in heights))
            for part, changed in zip(heights, parts, strict=True):
                part[before] = changed
            return heights
    _, factor, slope, curvature = smooth_step(xp.clip((x - switch_on[0]) / length, 0.0, 1.0))
    slope, curvature = slope / length, curvature / length**2
    r, r_x, r_xx = heights
    return (
        factor * r,
        factor * r_x + slope * r,
        factor * r_xx + 2 * slope * r_x + curvature * r,
    )


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


class SpectrumProfile(AbstractSpectralProfile):
    """Sum r = sum_i A_i cos(2 pi n_i x + phase_i) of given waves, everywhere.

    With `switch_on` it grows from 0 between two positions.

    >>> import jaxbeam as jb
    >>> profile = jb.profiles.SpectrumProfile(
    ...     wavenumbers=[0.1, 0.5], amplitudes=[0.01, 0.002], phases=[0.0, 1.0]
    ... )
    >>> heights, slopes, curvatures = profile.heights([0.0, 5.0])
    >>> print(heights.round(4))
    [ 0.0111 -0.0111]
    """

    kind: ClassVar[str] = "spectrum"

    wavenumbers: Float[Number, " line"] = number("1/m", "wavenumbers, cycles per metre", POSITIVE)
    amplitudes: Float[Number, " line"] = number("m", "amplitudes")
    phases: Float[Number, " line"] = number("rad", "phases at x = 0")
    switch_on: Float[Number, "2"] | None = number(
        "m", "positions where the profile begins and where it is all there", default=None
    )
    contact_length: Float[Number, ""] | None = number(
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


class ProfilesOfRuns(Module):
    """Concrete profiles of a batch of runs, whose waves differ in amplitudes and phases only.

    Its heights, slopes and curvatures have a last axis of runs.
    """

    first: SpectrumProfile
    amplitudes: Float[np.ndarray, "run line"]
    phases: Float[np.ndarray, "run line"]

    def heights(self, x) -> Heights:
        """Height (m), slope (1) and curvature (1/m) of each profile at positions x (m)."""
        x, wavenumbers = np.asarray(x, float), self.first.wavenumbers
        half = 0.5 * PANEL_PHASE / (2 * np.pi * np.max(np.abs(wavenumbers)))
        heights = _interpolated_sum(x, (wavenumbers, self.amplitudes, self.phases), half)
        switch_on = self.first.switch_on
        return heights if switch_on is None else _switched(x, switch_on, heights)


def profiles_of_runs(profiles: Sequence[AbstractProfile | None]) -> ProfilesOfRuns | None:
    """Batch of the profiles of runs; None unless they are waves of the same wavenumbers."""
    first, same = profiles[0], ("wavenumbers", "switch_on", "contact_length")
    given = [one for one in profiles if isinstance(one, SpectrumProfile)]
    if len(given) < len(profiles) or not isinstance(first, SpectrumProfile):
        return None
    if not all(np.array_equal(getattr(a, n), getattr(first, n)) for a in given for n in same):
        return None
    amplitudes = np.stack([one.averaged_amplitudes() for one in given])
    return ProfilesOfRuns(first, amplitudes, np.stack([one.phases for one in given]))


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


REFERENCE_WAVENUMBER = 0.1  # cycles per metre
ROAD_CLASSES = tuple("ABCDEFGH")


class ISO8608Profile(AbstractRandomProfile):
    """Road of a class of ISO 8608: S(n) = S(n0) (n / n0)^-2, n0 = 0.1 cycles per metre.

    S(n0) is the geometric mean of the limits of the class (ISO 8608:2016): 16e-6 m^3 for A, very
    good, and four times as much for each class after it. VBI-2D, for one, takes the middle of the
    limits, 20e-6 m^3 for A: `scale` = sqrt(20 / 16) is that. The default range, waves of 0.25 to
    100 m, is VBI-2D's. `class` is `road_class` in Python, where it is a reserved word.

    >>> import jaxbeam as jb
    >>> profile = jb.profiles.ISO8608Profile("A", seed=1)
    >>> print(f"{profile.density(0.1):.2g} m^3")
    1.6e-05 m^3
    """

    kind: ClassVar[str] = "iso8608"

    road_class: str = choice("roughness class", *ROAD_CLASSES)
    seed: int = count("seed of the phases", minimum=0, default=0)
    scale: Float[Number, ""] = number("1", "factor of the heights", NOT_NEGATIVE, default=1.0)
    lowest_wavenumber: Float[Number, ""] = number(
        "1/m", "lowest wavenumber, cycles per metre", POSITIVE, default=0.01
    )
    highest_wavenumber: Float[Number, ""] = number(
        "1/m", "highest wavenumber, cycles per metre", POSITIVE, default=4.0
    )
    waves: int = count("number of waves of the sum", default=100)
    switch_on: Float[Number, "2"] = number(
        "m",
        "positions where the profile begins and where it is all there",
        default=(-40.0, -30.0),
    )
    contact_length: Float[Number, ""] | None = number(
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


class RailProfile(AbstractRandomProfile):
    """Track of a spectrum of `jaxbeam.case.profiles.spectra`, which has the sources.

    "fra-1" (worst) to "fra-6" (best) of the Federal Railroad Administration, "german-low" and
    "german-high" disturbance, "sncf" (good track) and "sncf-poor". The wavelengths are those for
    which the spectrum was published, where none are given.

    >>> import jaxbeam as jb
    >>> profile = jb.profiles.RailProfile("fra-6", seed=1)
    >>> print(f"{profile.density(0.1):.2g} m^3")
    6.5e-07 m^3
    """

    kind: ClassVar[str] = "rail"

    spectrum: str = choice("spectrum of the track", *RAIL_SPECTRA)
    seed: int = count("seed of the phases", minimum=0, default=0)
    scale: Float[Number, ""] = number("1", "factor of the heights", NOT_NEGATIVE, default=1.0)
    shortest_wavelength: Float[Number, ""] | None = number(
        "m", "shortest wavelength", POSITIVE, default=None
    )
    longest_wavelength: Float[Number, ""] | None = number(
        "m", "longest wavelength", POSITIVE, default=None
    )
    waves: int = count("number of waves of the sum", default=100)
    switch_on: Float[Number, "2"] = number(
        "m",
        "positions where the profile begins and where it is all there",
        default=(-40.0, -30.0),
    )
    contact_length: Float[Number, ""] | None = number(
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
