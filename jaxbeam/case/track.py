"""Track between wheels and beam: it spreads the force of each axle along the beam.

An axle at x presses with shares w_k at x + o_k: on three sleepers, at any offsets, or evenly over a
length. What is off the beam then rests on the ground. A force on the modes psi is thus that of the
filtered shapes sum_k w_k psi(x + o_k) (see `jaxbeam.model.deflection_lines`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import (
    INCREASING,
    NOT_NEGATIVE,
    POSITIVE,
    choice,
    concrete,
    is_concrete,
    number,
)
from jaxbeam.case.reading.units import number_in_si
from jaxbeam.case.trajectory import AbstractTrajectory
from jaxbeam.runtime.arrays import Array, Number, xp

THREE_SLEEPERS = "3 sleepers"
SHARES = (0.25, 0.5, 0.25)  # of the rail supports under and beside an axle


class Kernel(NamedTuple):
    """Filter of a function of the position of a load: sum of weights times values at offsets (m).

    If it is `integrated`, values of the integral of the function from the left end.
    """

    offsets: Float[Array, " share"]
    weights: Float[Array, " share"]
    integrated: bool


class Track(ReprWithUnits):
    """How the track spreads the force of an axle along the beam, alike for all loads.

    On "3 sleepers" half of it acts on the middle one, and a quarter on each neighbour, at the
    `sleeper_spacing` (EN 1991-2, figure 6.4). Or the force is even over a `spread_length`, or acts
    at `spread_offsets` in the proportion of the `spread_shares`. For loads without mass or springs;
    one that has no `start_position` starts where its first share enters the beam.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.Axles(offsets=[0.0, 3.0], forces=[110e3, 110e3], speed=20.0)],
    ...     track=jb.Track(spread="3 sleepers"),
    ...     run=jb.Run(1.5),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    3.570 mm
    """

    spread: str = choice("rule of the spread", "", THREE_SLEEPERS, default="")
    sleeper_spacing: Float[Number, ""] = number(
        "m", "distance of the sleepers", POSITIVE, default=0.6
    )
    spread_length: Float[Number, ""] | None = number(
        "m", "length over which an axle is even", POSITIVE, default=None
    )
    spread_offsets: Float[Number, " share"] | None = number(
        "m", "places of the shares right of the axle", INCREASING, default=None
    )
    spread_shares: Float[Number, " share"] | None = number(
        "1", "proportions of the shares of an axle", NOT_NEGATIVE, default=None
    )

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        ways = {
            "spread": bool(self.spread),
            "spread_length": self.spread_length is not None,
            "spread_offsets": self.spread_offsets is not None,
        }
        given = [name for name, one in ways.items() if one]
        if len(given) > 1:
            return f"{address} has both {given[0]} and {given[1]}; leave one out"
        if not given:
            return (
                f"{address} spreads nothing: give spread = {THREE_SLEEPERS!r}, a spread_length, or"
                " spread_offsets with spread_shares; or leave the track out"
            )
        if (self.spread_offsets is None) != (self.spread_shares is None):
            absent = "spread_shares" if self.spread_shares is None else "spread_offsets"
            return f"{address}.{absent} is missing; each offset has its share"
        if self.spread_shares is None or self.spread_offsets is None:
            return None
        offsets, shares = np.shape(self.spread_offsets)[0], np.shape(self.spread_shares)[0]
        if offsets != shares:
            return (
                f"{address}.spread_shares has {shares} entries and spread_offsets has {offsets};"
                " give one for each"
            )
        if not offsets:
            return f"{address}.spread_offsets has no entry; give at least one"
        if is_concrete(self.spread_shares) and not np.any(concrete(self.spread_shares)):
            return f"{address}.spread_shares are all 0: one of them must be positive"
        return None

    def kernel(self) -> Kernel:
        """Filter of what depends on the position of a load."""
        if self.spread:
            offsets = self.sleeper_spacing * np.array([-1.0, 0.0, 1.0])
            return Kernel(offsets, xp.asarray(SHARES), False)
        if self.spread_length is not None:
            ends = np.array([-0.5, 0.5])
            return Kernel(self.spread_length * ends, 2 * ends / self.spread_length, True)
        return Kernel(self.spread_offsets, self.spread_shares / xp.sum(self.spread_shares), False)

    def ends(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Lowest and highest offset (m) of the shares of an axle."""
        offsets = self.kernel().offsets
        return offsets[0], offsets[-1]

    def start(self, speed: Float[Array, "*run"], length: Float[Array, ""]) -> Float[Array, "*run"]:
        """Position (m) of a load of a speed (m/s) whose first share is at its end of the beam."""
        lowest, highest = self.ends()
        return xp.where(speed < 0, length - lowest, -highest)


def track_of(text: str) -> Track:
    """Track of a spread in words: the name of a rule, or a length with or without its unit.

    Raises ValueError for other words.
    """
    if text == THREE_SLEEPERS:
        return Track(spread=text)
    try:
        return Track(spread_length=number_in_si(text, "m", "spread"))
    except ValueError as error:
        raise ValueError(
            f"spread cannot be {text!r}; it is {THREE_SLEEPERS!r}, or a length as '2.4 m'"
        ) from error


def windows(
    track: Track | None, path: AbstractTrajectory, behind: Float[Array, " wheel"]
) -> tuple[Float[Array, " wheel"], Float[Array, " wheel"]]:
    """Times (s) at which wheels `behind` the first (m) enter the beam and leave it.

    With a track, at which the first of their shares enters, and the last one leaves.
    """
    if track is None:
        return path.entry_exit_times(behind)
    each = [path.entry_exit_times(behind - path.direction() * end) for end in track.ends()]
    (first_entry, first_exit), (second_entry, second_exit) = each
    return xp.minimum(first_entry, second_entry), xp.maximum(first_exit, second_exit)
