"""Loads of one wheel: forces, constant, varying or by a table, and masses."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, ON_BEAM, number, validate_exactly_one
from jaxbeam.case.loads.base import (
    AbstractLoad,
    AbstractStandingLoad,
    AbstractVehicleLoad,
    ForceHistory,
    length_error,
    plain_wheels,
)
from jaxbeam.runtime.arrays import Number, xp


class MovingForce(AbstractLoad):
    """Constant force that travels along the beam: weight without inertia.

    Give the `force` in N (positive downwards), or the `mass` whose weight it is; its trajectory is
    given as for `MovingMass`.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.MovingForce(force=200e3, speed=30.0)],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    3.651 mm
    """

    kind: ClassVar[str] = "force"

    mass: Float[Number, ""] | None = number(
        "kg", "mass whose weight it is", NOT_NEGATIVE, default=None
    )
    force: Float[Number, ""] | None = number("N", "force, positive downwards", default=None)
    speed: Float[Number, ""] | None = number("m/s", "speed at entry", default=None)
    entry_time: Float[Number, ""] = number("s", "time of entry", default=0.0)
    deceleration: Float[Number, ""] = number("m/s^2", "constant deceleration", default=0.0)
    times: Float[Number, " point"] | None = number("s", "table: times", INCREASING, default=None)
    positions: Float[Number, " point"] | None = number("m", "table: positions", default=None)
    start_position: Float[Number, ""] | None = number(
        "m", "position at entry_time, before the beam", default=None
    )
    eccentricity: Float[Number, ""] | None = number(
        "m", "distance left of the axis of the beam, looking right", default=None, kw_only=True
    )

    def validate(self, address):
        return validate_exactly_one(address, self, "force", "mass") or super().validate(address)

    def total_mass(self, gravity):
        return self.mass

    def vehicle(self, gravity):
        force = self.force if self.force is not None else self.mass * gravity
        return plain_wheels(force, xp.zeros(()))


class VaryingForce(AbstractStandingLoad, AbstractVehicleLoad):
    """Force F(t) = `force` + sum of A sin(2 pi f t + phase) + a table, positive downwards.

    t is in s from the start of the run. The table has `forces` at `force_times`, straight lines
    between them and constant before and after. The force travels as other loads do, or stays at
    `position`, as a machine does.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[
    ...         jb.VaryingForce(force=200e3, frequencies=[4.0], amplitudes=[20e3], speed=30.0)
    ...     ],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    3.934 mm
    """

    kind: ClassVar[str] = "varying-force"

    force: Float[Number, ""] = number("N", "constant part", default=0.0)
    frequencies: Float[Number, " wave"] = number(
        "Hz", "frequencies of the waves", NOT_NEGATIVE, default=()
    )
    amplitudes: Float[Number, " wave"] = number("N", "amplitudes of the waves", default=())
    phases: Float[Number, " wave"] | None = number(
        "rad", "phases of the waves at the start of the run; 0 if left out", default=None
    )
    force_times: Float[Number, " entry"] | None = number(
        "s", "times of the table of forces", INCREASING, default=None
    )
    forces: Float[Number, " entry"] | None = number("N", "forces of the table", default=None)
    position: Float[Number, ""] | None = number(
        "m", "place of a force that does not travel", ON_BEAM, default=None
    )

    def validate(self, address):
        error = length_error(address, self, "frequencies", ("amplitudes", "phases"))
        if error is not None:
            return error
        if (self.force_times is None) != (self.forces is None):
            absent = "force_times" if self.force_times is None else "forces"
            return f"{address}.{absent} is missing; a table has both force_times and forces"
        if self.force_times is not None:
            error = length_error(address, self, "force_times", ("forces",))
        return error or super().validate(address)

    def vehicle(self, gravity):
        return plain_wheels(self.force, xp.zeros(()))

    def force_histories(self):
        phases = xp.zeros_like(self.frequencies) if self.phases is None else self.phases
        none = np.zeros(0)
        table = (none, none) if self.forces is None else (self.force_times, self.forces)
        return {0: ForceHistory(self.frequencies, self.amplitudes, phases, *table)}


class MovingMass(AbstractLoad):
    """Mass in permanent contact with the beam: its weight and its inertia act on the beam.

    Its vertical acceleration has all convective terms, w_tt + 2 v w_xt + v^2 w_xx + a w_x
    (corrected eq. (2.3) of the thesis). Give `speed` (negative: it enters at the right end and
    travels left), `entry_time` and `deceleration`; or a table of `times` and `positions`.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.MovingMass(mass=20e3, speed=30.0)],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    3.647 mm
    """

    kind: ClassVar[str] = "mass"

    mass: Float[Number, ""] = number("kg", "mass", NOT_NEGATIVE)
    speed: Float[Number, ""] | None = number("m/s", "speed at entry", default=None)
    entry_time: Float[Number, ""] = number("s", "time of entry", default=0.0)
    deceleration: Float[Number, ""] = number("m/s^2", "constant deceleration", default=0.0)
    times: Float[Number, " point"] | None = number("s", "table: times", INCREASING, default=None)
    positions: Float[Number, " point"] | None = number("m", "table: positions", default=None)
    start_position: Float[Number, ""] | None = number(
        "m", "position at entry_time, before the beam", default=None
    )
    eccentricity: Float[Number, ""] | None = number(
        "m", "distance left of the axis of the beam, looking right", default=None, kw_only=True
    )

    def total_mass(self, gravity):
        return self.mass

    def vehicle(self, gravity):
        return plain_wheels(self.mass * gravity, self.mass)
