"""Blows of a hammer in measured forces; windows of blows and of the responses to them.

A force window keeps the blow and drops the noise of the force sensor after it. An exponential
window exp(-t / T) lets the response fade before the noise prevails, or before the record ends. As
exp(-a t) (h * f) = (exp(-a t) h) * (exp(-a t) f), it multiplies force and response alike and then
adds a = 1 / T to each decay rate, which is subtracted from what is identified: exact for any force
(Fladung and Rost 1997).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

BLOW_SHARE = 0.1  # of the largest force, above which there is a blow
MAX_STRUCK_SHARE = 0.05  # of the samples of a log of blows
BEFORE = 8  # samples before a blow that belong to it: ringing of an anti-alias filter


class Windows(NamedTuple):
    """Time constant T (s) of the exponential window, duration (s) of the force window, or None."""

    exponential: float | None = None
    force: float | None = None

    @property
    def decay_rate(self) -> float:
        """What the exponential window adds to decay rates (1/s)."""
        return 0.0 if self.exponential is None else 1 / self.exponential


def check_windows(windows: Windows) -> None:
    """Check windows.

    Raises ValueError for a duration that is not above zero.
    """
    for name, value in zip(("exponential", "force"), windows, strict=True):
        if value is not None and not 0 < value < np.inf:
            raise ValueError(f"the {name} window must last longer than 0 s, not {value:g} s")


def find_blows(force: Float[np.ndarray, "time force"]) -> Int[np.ndarray, " blow"]:
    """Samples at which blows begin, none if the force is no hammer's.

    A hammer's force is above a tenth of its largest value for a twentieth of the time at most.
    """
    size = np.max(np.abs(force) / np.maximum(np.abs(force).max(axis=0), 1e-300), axis=1)
    struck = size > BLOW_SHARE
    if not struck.any() or struck.mean() > MAX_STRUCK_SHARE:
        return np.zeros(0, int)
    begins = np.flatnonzero(struck & ~np.concatenate([[False], struck[:-1]]))
    # Rebounds and ringing filters cross the level again at once.
    far = np.diff(begins, prepend=-len(force)) > 4 * struck.sum() / begins.size + 2
    return begins[far]


def _blows_of(force):
    """Samples at which blows begin. Raises ValueError if there are none."""
    blows = find_blows(force)
    if not blows.size:
        raise ValueError("the measured force has no blows of a hammer, and windows are for these")
    return blows


def force_at_blows(
    force: Float[np.ndarray, "time force"], rate: float, duration: float
) -> Float[np.ndarray, "time force"]:
    """The force for `duration` s from each blow on, and a little before; else zero.

    Raises ValueError if there is no blow.
    """
    kept = np.zeros(len(force), bool)
    for blow in _blows_of(force).tolist():
        kept[max(blow - BEFORE, 0) : blow + max(int(duration * rate), 1)] = True
    return np.where(kept[:, None], force, 0.0)


def pieces_of_blows(
    record: Float[np.ndarray, "time output"],
    force: Float[np.ndarray, "time force"],
    rate: float,
    windows: Windows,
) -> list[tuple[Float[np.ndarray, "sample output"], Float[np.ndarray, "sample force"]]]:
    """Response and force from each blow on for the shortest time between blows, with windows.

    Pieces begin a little before their blow. Raises ValueError if there is no blow.
    """
    blows = _blows_of(force)
    if windows.force is not None:
        force = force_at_blows(force, rate, windows.force)
    length = int(np.diff(np.append(blows, len(record))).min())
    fade = np.exp(-windows.decay_rate * np.arange(length) / rate)[:, None]
    starts = np.maximum(blows - BEFORE, 0).tolist()
    return [
        (record[first : first + length] * fade, force[first : first + length] * fade)
        for first in starts
        if first + length <= len(record)
    ]
