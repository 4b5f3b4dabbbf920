"""Profiles that are sums of cosines."""

import abc

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.profiles.base import AbstractProfile, Heights
from jaxbeam.case.profiles.smooth_step import smooth_step
from jaxbeam.runtime.arrays import Array, checkpoint, is_known, scan, xp, zeros

DIRECT_SIZE = 100_000  # cosines that are computed at once; more than these wave by wave
BLOCK = 16  # waves at once then: memory does not grow with their number
# Of known numbers the sum is interpolated on panels of so many rad of its shortest wave, with so
# many Chebyshev points each: their series of a cosine ends at J_24(4) = 2e-17.
PANEL_PHASE, PANEL_POINTS = 8.0, 24
LEAST_INTERPOLATED, LEAST_POSITIONS = 50_000, 4  # cosines in all, positions a panel
POSITIONS_AT_ONCE = 4096


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
        wavenumbers, amplitudes, phases = self.lines()
        if self.contact_length is not None:
            amplitudes = amplitudes * xp.sinc(wavenumbers * self.contact_length)
        heights = sum_of_cosines(x, wavenumbers, amplitudes, phases)
        return heights if self.switch_on is None else _switched(x, self.switch_on, heights)

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
    if x.size * count >= LEAST_INTERPOLATED and all(map(is_known, (x, *waves))):
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
    """The same with an array of positions by waves."""
    k = 2 * np.pi * wavenumbers
    angles = x[..., None] * k + phases
    even = xp.cos(angles) @ xp.stack([amplitudes, -amplitudes * k**2], axis=1)
    return even[..., 0], xp.sin(angles) @ (-amplitudes * k), even[..., 1]


def _interpolated_sum(x: np.ndarray, waves, half: float) -> Heights:
    """The same at many known positions, interpolated on panels of a `half` length (m).

    The waves at the Chebyshev points of all panels are products of those at their centres and of
    those at the points of one: few cosines, and products of matrices.
    """
    wavenumbers, amplitudes, phases = waves
    k, first = 2 * np.pi * wavenumbers, np.min(x)
    panel = ((x - first) / (2 * half)).astype(int).ravel()
    centres = first + half * (2 * np.arange(panel.max() + 1) + 1)
    at_centres = np.exp(1j * (centres[:, None] * k + phases))
    at_points = np.exp(1j * half * np.outer(k, chebyshev.chebpts1(PANEL_POINTS)))
    factors = (amplitudes, 1j * k * amplitudes, -(k**2) * amplitudes)
    values = np.stack([((at_centres * one) @ at_points).real for one in factors], axis=2)
    points = chebyshev.chebvander(chebyshev.chebpts1(PANEL_POINTS), PANEL_POINTS - 1)
    series = np.where(np.arange(PANEL_POINTS) == 0, 1.0, 2.0)[:, None] / PANEL_POINTS * points.T
    series = series @ values
    local = (x.ravel() - centres[panel]) / half
    found = np.empty((x.size, 3))
    for start in range(0, x.size, POSITIONS_AT_ONCE):
        here = slice(start, start + POSITIONS_AT_ONCE)
        table = chebyshev.chebvander(local[here], PANEL_POINTS - 1)
        found[here] = (table[:, None] @ series[panel[here]])[:, 0]
    height, slope, curvature = found.T.reshape(3, *x.shape)
    return height, slope, curvature


def _switched(x, switch_on, heights) -> Heights:
    """Product of a profile and the quintic from 0 to 1 between two positions."""
    length = switch_on[1] - switch_on[0]
    _, factor, slope, curvature = smooth_step(xp.clip((x - switch_on[0]) / length, 0.0, 1.0))
    slope, curvature = slope / length, curvature / length**2
    r, r_x, r_xx = heights
    return (
        factor * r,
        factor * r_x + slope * r,
        factor * r_xx + 2 * slope * r_x + curvature * r,
    )
