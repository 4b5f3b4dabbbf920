"""Tuned mass dampers and inerters that hang on the beam.

A body of mass m, height u, hangs at a place of the beam, height y, on a spring k, a damper c and an
inerter b side by side; a second inerter b_g joins it to the ground:

    (m + b_g) u'' = s + b (y'' - u''),   s = k (y - u) + c (y' - u'),   F = s + b (y'' - u''),

with F the force on the beam, positive downwards. Heights are from static equilibrium, in which the
absorber hangs when a run starts: its weight is part of the dead load. With m_t = m + b_g, the ratio
r = m_t / (m_t + b) and the height z of u = r z + (1 - r) y, this is an oscillator without inerter,

    r m_t z'' = r^2 s_z,   s_z = k (y - z) + c (y' - z'),   F = r^2 s_z + b r y'',

so that absorbers run as the vehicles of `jaxbeam.case.loads.base` do, standing.
"""

import numpy as np
from jaxtyping import Float

from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    concrete,
    is_concrete,
    number,
    validate_exactly_one,
)
from jaxbeam.case.loads.base import ForceHistory, VehicleModel
from jaxbeam.case.trajectory import StandingTrajectory
from jaxbeam.runtime.arrays import Array, Number, xp


class Absorber(ReprWithUnits):
    """Tuned mass damper at a position of the beam, with inerters where they are given.

    Spring and damper are given by `stiffness` or `frequency`, and `damping` or `damping_ratio`:
    those of the absorber on a beam at rest, with omega^2 = k / (m + b + b_g) and
    zeta = c / (2 (m + b + b_g) omega). Without a mass, `ground_inertance` makes it a tuned inerter
    damper. A run in which the stroke exceeds `max_stroke` is warned of.

    >>> import dataclasses
    >>> import jaxbeam as jb
    >>> bridge = jb.Case(
    ...     jb.Beam(25.0, 30e9, 15e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(12.5)],
    ...     loads=[jb.Axles(train="HSLM-A1", speed=62.5)],
    ...     run=jb.Run(7.0, sample_rate=200.0),
    ... )
    >>> damper = jb.Absorber(12.5, mass=3750.0, frequency=3.48, damping_ratio=0.086)
    >>> damped = dataclasses.replace(bridge, absorbers=[damper])
    >>> peaks = [jb.simulate(case).peak_deflection[0] for case in (bridge, damped)]
    >>> print(*(f"{1e3 * peak:.1f} mm" for peak in peaks))
    13.9 mm 8.8 mm
    """

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    mass: Float[Number, ""] = number("kg", "mass of the body", NOT_NEGATIVE, default=0.0)
    stiffness: Float[Number, ""] | None = number("N/m", "spring", POSITIVE, default=None)
    damping: Float[Number, ""] | None = number("N s/m", "damper", NOT_NEGATIVE, default=None)
    frequency: Float[Number, ""] | None = number(
        "Hz", "natural frequency on a beam at rest", POSITIVE, default=None
    )
    damping_ratio: Float[Number, ""] | None = number(
        "1", "damping ratio on a beam at rest", NOT_NEGATIVE, default=None
    )
    inertance: Float[Number, ""] = number(
        "kg", "inerter between body and beam", NOT_NEGATIVE, default=0.0
    )
    ground_inertance: Float[Number, ""] = number(
        "kg", "inerter between body and ground", NOT_NEGATIVE, default=0.0
    )
    max_stroke: Float[Number, ""] | None = number(
        "m", "largest allowed motion of the body relative to the beam", POSITIVE, default=None
    )

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        inert = self.mass, self.ground_inertance
        if all(map(is_concrete, inert)) and not any(concrete(one) > 0 for one in inert):
            return (
                f"{address}.mass must be positive, as nothing moves otherwise; an inerter damper"
                " without mass has a ground_inertance"
            )
        return validate_exactly_one(
            address, self, "stiffness", "frequency"
        ) or validate_exactly_one(address, self, "damping", "damping_ratio")

    @property
    def moving_mass(self) -> Float[Array, ""]:
        """Inertia (kg) of the body on a beam at rest: its mass and both inertances."""
        return self.mass + self.ground_inertance + self.inertance

    @property
    def spring(self) -> Float[Array, ""]:
        """Stiffness k (N/m), given or by the frequency."""
        if self.stiffness is not None:
            return self.stiffness
        return self.moving_mass * (2 * np.pi * self.frequency) ** 2

    @property
    def damper(self) -> Float[Array, ""]:
        """Damping c (N s/m), given or by the damping ratio."""
        if self.damping is not None:
            return self.damping
        return 2 * self.damping_ratio * xp.sqrt(self.spring * self.moving_mass)

    @property
    def body_fraction(self) -> Float[Array, ""]:
        """r of the module, the fraction of the equivalent oscillator's stroke that the body has."""
        return (self.mass + self.ground_inertance) / self.moving_mass

    def vehicle(self, gravity: Float[Array, ""]) -> VehicleModel:
        """Equivalent oscillator, without weight; see the module. `gravity` has no influence."""
        fraction = self.body_fraction
        body = fraction * (self.mass + self.ground_inertance)
        nothing = np.zeros((1, 1))
        return VehicleModel(
            offsets=np.zeros(1),
            static_loads=np.zeros(1),
            wheel_masses=xp.reshape(fraction * self.inertance, 1),
            contact_stiffness=xp.reshape(fraction**2 * self.spring, 1),
            contact_damping=xp.reshape(fraction**2 * self.damper, 1),
            mass=xp.reshape(body, (1, 1)),
            damping=nothing,
            stiffness=nothing,
            wheel_map=np.ones((1, 1)),
            names=("body",),
        )

    def trajectory(self, length: Float[Array, ""]) -> StandingTrajectory:
        """Trajectory of the absorber, at its position from the start of a run."""
        return StandingTrajectory(self.position, np.zeros(()), length)

    def spacings(self) -> Float[Array, " vehicle"]:
        """Distances (m) of the absorbers of the row behind the first: 0, as it is one."""
        return xp.zeros(1)

    def force_histories(self) -> dict[int, ForceHistory]:
        """Forces over time by index of the wheel: no entries."""
        return {}
