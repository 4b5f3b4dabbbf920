"""Track between wheels and beam: it spreads the force of each axle, or moves with beam and wheels.

An axle at x presses with fractions w_k at x + o_k: on three sleepers, at any offsets, or over a
length. What is off the beam then rests on the ground. A force on the modes psi is thus that of the
filtered shapes sum_k w_k psi(x + o_k) (see `jaxbeam.model.deflection_lines`). A track of layers,
rail, pads, sleepers and ballast, has modes with the beam (see `jaxbeam.model.track`).
"""

import dataclasses
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
from jaxbeam.case.toml_file import number_in_si
from jaxbeam.case.trajectory import AbstractTrajectory
from jaxbeam.runtime.arrays import Array, Number, xp

THREE_SLEEPERS = "3 sleepers"
SLEEPER_FRACTIONS = (0.25, 0.5, 0.25)  # of an axle, on the sleepers before, under and behind it
APPROACH = 20.0  # m, of a rail on the ground
LAYERS = "rail_mass", "pad_stiffness", "sleeper_mass", "ballast_stiffness"


class Kernel(NamedTuple):
    """Kernel that spreads an axle: sum of weights times values of a function at offsets (m).

    If `integrated`, of values of the function's integral from the left end.
    """

    offsets: Float[Array, " share"]
    weights: Float[Array, " share"]
    integrated: bool


class Track(ReprWithUnits):
    """Track on the beam, alike for all loads: a rule that spreads axles, or layers that move.

    On "3 sleepers" half of the force of an axle acts on the middle one, and a quarter on each
    neighbour, at the `sleeper_spacing` (EN 1991-2, figure 6.4). Or the force is even over a
    `spread_length`, or acts at `spread_offsets` in the proportion of the `spread_shares`. These
    rules are for loads without mass or springs.

    With a `rail_rigidity` all wheels run on a rail, an Euler-Bernoulli beam on pads, sleepers and
    ballast: pads, sleepers and ballast of one sleeper, for both rails, are even along the
    `sleeper_spacing`. The rail lies on the beam and, for the length of an `approach`, on rigid
    ground on both sides; its ends are pinned. The mass of the ballast is part of that of the beam.
    The modes of the case are then those of beam and track together, and `beam.modes` must reach the
    frequencies of interest of both.

    A load without a `start_position` starts where its first point force enters the beam, or at the
    end of the rail.

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
        "m", "places of the point forces right of the axle", INCREASING, default=None
    )
    spread_shares: Float[Number, " share"] | None = number(
        "1", "proportions of the point forces of an axle", NOT_NEGATIVE, default=None
    )

    rail_rigidity: Float[Number, ""] | None = number(
        "N m^2", "bending stiffness E I of both rails", POSITIVE, default=None
    )
    rail_mass: Float[Number, ""] | None = number(
        "kg/m", "mass per length of both rails", POSITIVE, default=None
    )
    pad_stiffness: Float[Number, ""] | None = number(
        "N/m", "stiffness of the pads of a sleeper", POSITIVE, default=None
    )
    pad_damping: Float[Number, ""] = number(
        "N s/m", "damper of the pads of a sleeper", NOT_NEGATIVE, default=0.0
    )
    sleeper_mass: Float[Number, ""] | None = number(
        "kg", "mass of a sleeper", POSITIVE, default=None
    )
    ballast_stiffness: Float[Number, ""] | None = number(
        "N/m", "stiffness of the ballast under a sleeper", POSITIVE, default=None
    )
    ballast_damping: Float[Number, ""] = number(
        "N s/m", "damper of the ballast under a sleeper", NOT_NEGATIVE, default=0.0
    )
    approach: Float[Number, ""] | None = number(
        "m",
        "length of the rail on the ground before and behind the beam; 20 m if left out",
        POSITIVE,
        default=None,
    )

    @property
    def layered(self) -> bool:
        """Whether it has a rail on layers that move, instead of a rule that spreads forces."""
        return self.rail_rigidity is not None

    @property
    def ground(self) -> Float[Array, ""]:
        """Length of the rail on the ground (m), on each side of the beam."""
        return xp.asarray(APPROACH if self.approach is None else self.approach)

    def least_modes(self, length: Float[Array, ""]) -> int:
        """Least number of modes with which the rail on a beam of a length (m) bends under a wheel.

        Their sines reach wavelengths of five times (4 B / k)^(1/4), the length of a rail of the
        rigidity B on the springs k (N/m^2) of pads and ballast one on the other.
        """
        springs = 1.0 / (1.0 / self.pad_stiffness + 1.0 / self.ballast_stiffness)
        wave = 5.0 * (4.0 * self.rail_rigidity * self.sleeper_spacing / springs) ** 0.25
        return int(np.ceil(4.0 * (length + 2.0 * self.ground) / wave))

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        ways = {
            "spread": bool(self.spread),
            "spread_length": self.spread_length is not None,
            "spread_offsets": self.spread_offsets is not None,
            "rail_rigidity": self.layered,
        }
        given = [name for name, one in ways.items() if one]
        if len(given) > 1:
            return f"{address} has both {given[0]} and {given[1]}; leave one out"
        layers = {name: getattr(self, name) is not None for name in (*LAYERS, "approach")}
        absent = [name for name in LAYERS if not layers[name]]
        if self.layered and absent:
            names = ", ".join(("rail_rigidity", *LAYERS))
            return f"{address}.{absent[0]} is missing; a track of layers has {names}"
        if not self.layered and any(layers.values()):
            first = next(name for name, given in layers.items() if given)
            return (
                f"{address}.{first} would have no effect: give {address}.rail_rigidity, or leave it"
                " out"
            )
        if not given:
            return (
                f"{address} spreads nothing: give spread = {THREE_SLEEPERS!r}, a spread_length,"
                " spread_offsets with spread_shares, or a rail_rigidity and the layers below; or"
                " leave the track out"
            )
        if (self.spread_offsets is None) != (self.spread_shares is None):
            absent = "spread_shares" if self.spread_shares is None else "spread_offsets"
            return f"{address}.{absent} is missing; each offset has its fraction of the axle"
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
        """Kernel that spreads the force of an axle; of layers one that does not."""
        if self.layered:
            return Kernel(np.zeros(1), np.ones(1), False)
        if self.spread:
            offsets = self.sleeper_spacing * np.array([-1.0, 0.0, 1.0])
            return Kernel(offsets, xp.asarray(SLEEPER_FRACTIONS), False)
        if self.spread_length is not None:
            ends = np.array([-0.5, 0.5])
            return Kernel(self.spread_length * ends, 2 * ends / self.spread_length, True)
        return Kernel(self.spread_offsets, self.spread_shares / xp.sum(self.spread_shares), False)

    def ends(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Lowest and highest offset (m) from which an axle presses, on the beam or on its rail."""
        if self.layered:
            return -self.ground, self.ground
        offsets = self.kernel().offsets
        return offsets[0], offsets[-1]

    def start(self, speed: Float[Array, "*run"], length: Float[Array, ""]) -> Float[Array, "*run"]:
        """Position (m) of a load at a speed (m/s) whose first force is at its end of the beam."""
        lowest, highest = self.ends()
        return xp.where(speed < 0, length - lowest, -highest)


def track_of(text: str) -> Track:
    """Track of a spreading rule in words: its name, or a length with or without unit.

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

    With a track that spreads axles, the entry of the first point force and the exit of the last;
    with a rail, entry and exit of the rail.
    """
    if track is None:
        return path.entry_exit_times(behind)
    if track.layered:
        of_rail = dataclasses.replace(path, length=path.length + 2 * track.ground)
        return of_rail.entry_exit_times(behind - path.direction() * track.ground)
    each = [path.entry_exit_times(behind - path.direction() * end) for end in track.ends()]
    (first_entry, first_exit), (second_entry, second_exit) = each
    return xp.minimum(first_entry, second_entry), xp.maximum(first_exit, second_exit)
