"""Interface of loads that travel along the beam.

A load is a vehicle, in the simplest case a mass or a force, with a trajectory x(t) (m) of its first
wheel: constant deceleration, or a table of positions (see `jaxbeam.case.trajectory`).
"""

import abc
from typing import ClassVar

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.absorbers import Absorber
from jaxbeam.case.declared_checks import validate_exactly_one
from jaxbeam.case.display.parts import ReprWithUnits
from jaxbeam.case.fields import INCREASING, concrete, is_concrete, number
from jaxbeam.case.loads.force_history import ForceHistory
from jaxbeam.case.loads.vehicle_model import VehicleModel
from jaxbeam.case.trajectory import (
    AbstractPiecewiseTrajectory,
    BrakingTrajectory,
    TabulatedTrajectory,
)
from jaxbeam.runtime.arrays import Array, xp


class AbstractLoad(ReprWithUnits):
    """Interface of loads. A subclass that declares a `kind` is one of case files."""

    kind: ClassVar[str]
    speed: eqx.AbstractVar[Float[Array, ""] | None]
    entry_time: eqx.AbstractVar[Float[Array, ""]]
    deceleration: eqx.AbstractVar[Float[Array, ""]]
    times: eqx.AbstractVar[Float[Array, " point"] | None]
    positions: eqx.AbstractVar[Float[Array, " point"] | None]

    start_position: eqx.AbstractVar[Float[Array, ""] | None]

    @abc.abstractmethod
    def vehicle(self, gravity: Float[Array, ""]) -> VehicleModel:
        """Vehicle of the load, one of `spacings`; `gravity` in m/s^2."""

    def trajectory(self, length: Float[Array, ""]) -> AbstractPiecewiseTrajectory:
        """Trajectory of its first wheel along a beam of a length (m)."""
        if self.times is not None:
            return TabulatedTrajectory(self.times, self.positions, length)
        start = self.speed, self.entry_time, self.deceleration, length, self.start_position
        return BrakingTrajectory(*start)

    def force_histories(self) -> dict[int, ForceHistory]:
        """Forces over time of its wheels in addition to the static loads, by index of the wheel."""
        return {}

    def total_mass(self, gravity: Float[Array, ""]) -> Float[Array, ""] | None:
        """Mass (kg) whose weight its wheels carry; None for a force that is no weight."""
        wheels = self.vehicle(gravity).static_loads
        return self.spacings().shape[0] * xp.sum(wheels) / gravity

    def spacings(self) -> Float[Array, " vehicle"]:
        """Distances (m) of the first wheels of its vehicles, all alike, behind the first wheel."""
        return xp.zeros(1)

    def by_numbers(self) -> "AbstractLoad":
        """The same load with numbers in place of the names of a library, where they mean the same.

        Loads of equal structure share compiled programs.
        """
        return self

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
            return self._start_error(address)
        time_count, position_count = self.times.shape[0], self.positions.shape[0]
        if time_count != position_count:
            return (
                f"{address} has {time_count} times and {position_count} positions;"
                " a table needs one position for each time"
            )
        if time_count < 2:
            return f"{address}.times needs at least two points; it has {time_count}"
        for name in ("entry_time", "deceleration", "start_position"):
            value = getattr(self, name)
            if value is not None and is_concrete(value) and concrete(value) != 0:
                return (
                    f"{address}.{name} would have no effect: a table of times and positions gives"
                    " the trajectory; leave it out"
                )
        return None

    def _start_error(self, address: str) -> str | None:
        """Error message if the load starts on the beam or behind its entry, or None."""
        start, speed = self.start_position, self.speed
        if start is None or not (is_concrete(start) and is_concrete(speed)):
            return None
        if concrete(speed) > 0 and concrete(start) > 0:
            return (
                f"{address}.start_position is {concrete(start):g} m, where a load that travels"
                " right is past its entry at 0 m; give a negative one, or a table of positions"
            )
        return None


class AbstractVehicleLoad(AbstractLoad):
    """Load with the numbers of a trajectory as keyword arguments, for loads of several numbers.

    The first wheel is at `start_position`, by default at the end of the beam at which it enters, at
    `entry_time`. At t = 0 it is in static equilibrium on the heights of the profile under its
    wheels, on its way with `speed`, which is constant until `entry_time`.
    """

    speed: Float[Array, ""] | None = number(
        "m/s", "speed at entry; negative: to the left", default=None, kw_only=True
    )
    entry_time: Float[Array, ""] = number(
        "s", "time at which the first wheel is at start_position", default=0.0, kw_only=True
    )
    deceleration: Float[Array, ""] = number(
        "m/s^2", "constant deceleration from entry_time", default=0.0, kw_only=True
    )
    times: Float[Array, " point"] | None = number(
        "s", "table: times", INCREASING, default=None, kw_only=True
    )
    positions: Float[Array, " point"] | None = number(
        "m", "table: positions of the first wheel", default=None, kw_only=True
    )
    start_position: Float[Array, ""] | None = number(
        "m",
        "position of the first wheel at entry_time, before the beam",
        default=None,
        kw_only=True,
    )


def trajectory(load: AbstractLoad, length: Float[Array, ""]) -> AbstractPiecewiseTrajectory:
    """Trajectory of a load along a beam of a length (m)."""
    return load.trajectory(length)


def wheel_distances(load: AbstractLoad | Absorber, vehicle: VehicleModel) -> Float[Array, " wheel"]:
    """Distances (m) of all wheels of a load, whose vehicles are given, behind its first one."""
    return (load.spacings()[:, None] + vehicle.offsets).reshape(-1)
