"""Modes identified from samples, and the reasons for which some are rejected."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

MAX_RELATIVE_DAMPING_SD = 0.3  # standard deviation of a damping ratio over the ratio
MAX_DAMPING_RATIO = 0.2
MIN_CYCLES = 4.0  # cycles of a mode in the window
MIN_ENERGY_SHARE = 0.002  # of the energy of the log in the band
MAX_BAND_SHARE = 0.98  # of the upper end of the band; a mode above may be the flank of another


class IdentifiedMode(NamedTuple):
    """A mode: undamped natural frequency (Hz) and damping ratio, with standard deviations.

    `energy_share` is its share of the energy of the log in the band.
    """

    frequency: float
    frequency_sd: float
    damping_ratio: float
    damping_sd: float
    energy_share: float


class ModeCandidates(NamedTuple):
    """Candidate modes with the reason for rejecting each (empty for a mode that is accepted).

    `start` and `stop` are the samples used; `quantile` times a standard deviation is half a 95 %
    interval; `measured` and `fitted` are the part in the band of the log and of the fit (None
    without a fit in time).
    """

    modes: tuple[IdentifiedMode, ...]
    rejection_reasons: tuple[str, ...]
    start: int
    stop: int
    quantile: float
    measured: Float[np.ndarray, "sample channel"]
    fitted: Float[np.ndarray, "sample channel"] | None


def rejection_reason(mode: IdentifiedMode, duration: float, band: tuple[float, float]) -> str:
    """Reason why a mode found in `duration` seconds is not well identified; empty if it is."""
    if not band[0] <= mode.frequency <= MAX_BAND_SHARE * band[1]:
        return "at the edge of the band"
    if mode.damping_ratio < 2 * mode.damping_sd:
        return "damping not distinguishable from none: hum, or a mode too weak or too short"
    if mode.damping_ratio > MAX_DAMPING_RATIO:
        return "damped so strongly that it may be no mode"
    if mode.frequency * duration < MIN_CYCLES:
        return "too few cycles in the window"
    if mode.damping_sd > MAX_RELATIVE_DAMPING_SD * mode.damping_ratio:
        return f"damping uncertain by {100 * mode.damping_sd / mode.damping_ratio:.0f} %"
    if mode.energy_share < MIN_ENERGY_SHARE:
        return f"{100 * mode.energy_share:.2f} % of the energy"
    return ""
