"""Loads that travel along the beam: masses and forces.

A load has an inertia (kg), a weight (N) and a trajectory x(t) (m): constant deceleration, or a
table of positions (see `jaxbeam.case.trajectory`).
"""

import abc
from typing import ClassVar

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.declared_checks import validate_exactly_one
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, concrete, is_concrete, number
from jaxbeam.case.trajectory import (
    AbstractPiecewiseTrajectory,
    BrakingTrajectory,
    TabulatedTrajectory,
)
from jaxbeam.runtime.arrays import Array, xp


class AbstractLoad(eqx.Module):
    """Interface of loads. A subclass that declares a `kind` is one of case files."""

    kind: ClassVar[str]
    speed: eqx.AbstractVar[Float[Array, ""] | None]
    entry_time: eqx.AbstractVar[Float[Array, ""]]
    deceleration: eqx.AbstractVar[Float[Array, ""]]
    times: eqx.AbstractVar[Float[Array, " point"] | None]
    positions: eqx.AbstractVar[Float[Array, " point"] | None]

    @abc.abstractmethod
    def inertia(self) -> Float[Array, ""]:
        """Mass (kg) that follows the deflection of the beam."""

    @abc.abstractmethod
    def weight(self, gravity: Float[Array, ""]) -> Float[Array, ""]:
        """Force (N) on a beam at rest, positive downwards; `gravity` in m/s^2."""

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        if (self.times is None) != (self.positions is None):
            absent = "times" if self.times is None else "positions"
            return f"{address}.{absent} is missing; a table has both times and positions"
        error = validate_exactly_one(address, self, "speed", "times")
        if error is not None:
            return error
        if self.times is None or self.positions is None:
            if is_concrete(self.speed) and concrete(self.speed) == 0:
                return (
                    f"{address}.speed must not be 0: the load would never enter; a load that"
                    " stands on the beam is a table of times and positions"
                )
            return None
        time_count, position_count = self.times.shape[0], self.positions.shape[0]
        if time_count != position_count:
            return (
                f"{address} has {time_count} times and {position_count} positions;"
                " a table needs one position for each time"
            )
        if time_count < 2:
            return f"{address}.times needs at least two points; it has {time_count}"
        for name in ("entry_time", "deceleration"):
            value = getattr(self, name)
            if is_concrete(value) and concrete(value) != 0:
                return (
                    f"{address}.{name} would have no effect: a table of times and positions gives"
                    " the trajectory; leave it out"
                )
        return None


class MovingMass(AbstractLoad):
    """Mass in permanent contact with the beam: its weight and its inertia act on the beam.

    Its vertical acceleration has all convective terms, w_tt + 2 v w_xt + v^2 w_xx + a w_x
    (corrected eq. (2.3) of the thesis). Give `speed` (negative: it enters at the right end and
    travels left), `entry_time` and `deceleration`; or a table of `times` and `positions`.
    """

    kind: ClassVar[str] = "mass"

    mass: Float[Array, ""] = number("kg", "mass", NOT_NEGATIVE)
    speed: Float[Array, ""] | None = number("m/s", "speed at entry", default=None)
    entry_time: Float[Array, ""] = number("s", "time of entry", default=0.0)
    deceleration: Float[Array, ""] = number("m/s^2", "constant deceleration", default=0.0)
    times: Float[Array, " point"] | None = number("s", "table: times", INCREASING, default=None)
    positions: Float[Array, " point"] | None = number("m", "table: positions", default=None)

    def inertia(self):
        return self.mass

    def weight(self, gravity):
        return self.mass * gravity


class MovingForce(AbstractLoad):
    """Constant force that travels along the beam: weight without inertia.

    Give the `force` in N (positive downwards), or the `mass` whose weight it is; its trajectory is
    given as for `MovingMass`.
    """

    kind: ClassVar[str] = "force"

    mass: Float[Array, ""] | None = number(
        "kg", "mass whose weight it is", NOT_NEGATIVE, default=None
    )
    force: Float[Array, ""] | None = number("N", "force, positive downwards", default=None)
    speed: Float[Array, ""] | None = number("m/s", "speed at entry", default=None)
    entry_time: Float[Array, ""] = number("s", "time of entry", default=0.0)
    deceleration: Float[Array, ""] = number("m/s^2", "constant deceleration", default=0.0)
    times: Float[Array, " point"] | None = number("s", "table: times", INCREASING, default=None)
    positions: Float[Array, " point"] | None = number("m", "table: positions", default=None)

    def inertia(self):
        return xp.zeros(())

    def validate(self, address):
        return validate_exactly_one(address, self, "force", "mass") or super().validate(address)

    def weight(self, gravity):
        return self.force if self.force is not None else self.mass * gravity


def trajectory(load: AbstractLoad, length: Float[Array, ""]) -> AbstractPiecewiseTrajectory:
    """Trajectory of a load along a beam of a length (m)."""
    if load.times is not None:
        return TabulatedTrajectory(load.times, load.positions, length)
    return BrakingTrajectory(load.speed, load.entry_time, load.deceleration, length)
