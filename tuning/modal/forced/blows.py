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
PRE_TRIGGER = 0.01  # of the time to the next blow, before a blow


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


def pieces_of_blows(
    record: Float[np.ndarray, "time output"],
    force: Float[np.ndarray, "time force"],
    rate: float,
    windows: Windows,
    *,
    alike: bool = False,
) -> list[tuple[int, Float[np.ndarray, "sample output"], Float[np.ndarray, "sample force"]]]:
    """First sample, response and force of each piece from one blow to the next, with windows.

    Pieces begin a little before their blow; with `alike` all are as long as the shortest. Raises
    ValueError if there is no blow.
    """
    blows = find_blows(force)
    if not blows.size:
        raise ValueError("the measured force has no blows of a hammer, and windows are for these")
    gaps = np.diff(np.append(blows, len(record)))
    before = min(int(PRE_TRIGGER * gaps.min()), int(blows[0]))
    length = int(gaps.min())
    found = []
    for blow, gap in zip(blows.tolist(), gaps.tolist(), strict=True):
        first = blow - before
        piece = slice(first, min(first + (length if alike else gap), len(record)))
        own, driving = record[piece].copy(), force[piece].copy()
        if windows.force is not None:
            driving[before + max(int(windows.force * rate), 1) :] = 0.0
        fade = np.exp(-windows.decay_rate * np.arange(len(own)) / rate)[:, None]
        found.append((first, own * fade, driving * fade))
    return found
