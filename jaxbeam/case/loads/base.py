"""Loads: the interface, rows of several, checks of their numbers, and those of one wheel.

The heights u of the degrees of freedom, positive upwards, are measured from static equilibrium on a
level surface. With the height y of the surface under each wheel (deflection plus profile), the
force of a wheel on the surface, positive in compression, and the motion of the vehicle are

    F = P + k (y - N u) + c (y' - N u') + m y'',
    M u'' + C u' + K u = N^T (k (y - N u) + c (y' - N u')),

with static wheel loads P, contact stiffness k and damping c, the unsprung mass m that follows the
surface, and N u the heights above the wheels. A mass has no degree of freedom, and k = c = 0.

A load is a vehicle, in the simplest case a mass or a force, with a trajectory x(t) (m) of its first
wheel: constant deceleration, or a table of positions (see `jaxbeam.case.trajectory`).
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case import fields
from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import (
    INCREASING,
    NOT_NEGATIVE,
    ON_BEAM,
    concrete,
    is_concrete,
    number,
    validate_exactly_one,
)
from jaxbeam.case.trajectory import (
    AbstractPiecewiseTrajectory,
    BrakingTrajectory,
    StandingTrajectory,
    TabulatedTrajectory,
)
from jaxbeam.runtime.arrays import Array, Module, Number, cholesky, solve, xp
from jaxbeam.runtime.printer import counted

_LOAD_TOLERANCE = 1e-9  # of the mean wheel load: a smaller one carries nothing


class ForceHistory(Module):
    """History of a force (N, positive downwards) in addition to a constant one.

    The sum of A sin(2 pi f t + phase) and of a table of forces at times, with straight lines
    between them, constant before and after; t in s. Runs of a batch differ along a last axis.
    """

    frequencies: Float[Array, "wave *batch"]
    amplitudes: Float[Array, "wave *batch"]
    phases: Float[Array, "wave *batch"]
    times: Float[Array, "entry *batch"]
    forces: Float[Array, "entry *batch"]

    def at(self, times: Float[Array, "*time"]) -> Float[Array, "*time_and_batch"]:
        """Force (N) at times (s), the batch axis last."""
        batch = (1,) * (self.amplitudes.ndim - 1)
        t = xp.asarray(times).reshape(*xp.shape(times), 1, *batch)
        axis = -1 - len(batch)
        angles = 2 * np.pi * self.frequencies * t + self.phases
        force = xp.sum(self.amplitudes * xp.sin(angles), axis=axis)
        if self.times.shape[0] == 0:
            return force
        slopes = xp.diff(self.forces, axis=0) / xp.diff(self.times, axis=0)
        elapsed = xp.clip(t - self.times[:-1], 0.0, xp.diff(self.times, axis=0))
        return force + self.forces[0] + xp.sum(slopes * elapsed, axis=axis)


class VehicleModel(Module):
    """Matrices of one vehicle: its equations of motion, and the forces of its wheels.

    `offsets` are the distances (m) of the wheels behind the first one. Wheels have static loads P
    (N), unsprung masses m (kg), and k (N/m) and c (N s/m) of the springs between surface and
    vehicle. M, C, K belong to the vehicle without these; `wheel_map` is N. `names` are those of the
    degrees of freedom: heights in m, and pitch angles in rad where the name ends in "pitch".
    """

    offsets: Float[Array, " wheel"]
    static_loads: Float[Array, " wheel"]
    wheel_masses: Float[Array, " wheel"]
    contact_stiffness: Float[Array, " wheel"]
    contact_damping: Float[Array, " wheel"]
    mass: Float[Array, "dof dof"]
    damping: Float[Array, "dof dof"]
    stiffness: Float[Array, "dof dof"]
    wheel_map: Float[Array, "wheel dof"]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def full_stiffness(self) -> Float[Array, "dof dof"]:
        """Stiffness (N/m) of the vehicle on a rigid surface."""
        contact = self.contact_stiffness[:, None] * self.wheel_map
        return self.stiffness + self.wheel_map.T @ contact

    @property
    def full_damping(self) -> Float[Array, "dof dof"]:
        """Damping (N s/m) of the vehicle on a rigid surface."""
        contact = self.contact_damping[:, None] * self.wheel_map
        return self.damping + self.wheel_map.T @ contact

    def natural_frequencies(self) -> Float[Array, " dof"]:
        """Undamped natural frequencies (Hz) on a rigid surface, ascending.

        det(K - (2 pi f)^2 M) = 0 with the springs of the wheels in K.
        """
        if not self.names:
            return xp.zeros(0)
        half_solved = solve(factor := cholesky(self.mass), self.full_stiffness)
        scaled = solve(factor, half_solved.T)
        values = xp.linalg.eigvalsh((scaled + scaled.T) / 2)
        return xp.sqrt(xp.maximum(values, 0.0)) / (2 * np.pi)


def plain_wheels(
    static_loads: Float[Array, "*wheel"],
    masses: Float[Array, "*wheel"],
    offsets: Float[Array, " wheel"] | None = None,
) -> VehicleModel:
    """Vehicle model of bare wheels: forces (N) and masses (kg) that follow the surface."""
    static_loads, masses = xp.reshape(static_loads, -1), xp.reshape(masses, -1)
    wheels = static_loads.shape[0]
    none, nothing = xp.zeros(wheels), np.zeros((0, 0))
    offsets = none if offsets is None else offsets
    matrices = nothing, nothing, nothing, np.zeros((wheels, 0))
    return VehicleModel(offsets, static_loads, masses, none, none, *matrices, ())


class AbstractLoad(ReprWithUnits):
    """What crosses the beam or stands on it: force, mass, vehicle, train, pedestrian or crowd.

    To add one, write a file in `jaxbeam.case.loads` with a subclass that declares its `kind`.
    """

    kind: ClassVar[str]
    speed: eqx.AbstractVar[Float[Array, ""] | None]
    entry_time: eqx.AbstractVar[Float[Array, ""]]
    deceleration: eqx.AbstractVar[Float[Array, ""]]
    times: eqx.AbstractVar[Float[Array, " point"] | None]
    positions: eqx.AbstractVar[Float[Array, " point"] | None]

    start_position: eqx.AbstractVar[Float[Array, ""] | None]
    eccentricity: eqx.AbstractVar[Float[Array, ""] | None]

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
        """The same load with the numbers of the library in place of names, where these are equal.

        Loads of equal structure use the same compiled programs.
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
                f"{address} has {counted(time_count, 'time')} and"
                f" {counted(position_count, 'position')}; a table needs one position for each time"
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

    speed: Float[Number, ""] | None = number(
        "m/s", "speed at entry; negative: to the left", default=None, kw_only=True
    )
    entry_time: Float[Number, ""] = number(
        "s", "time at which the first wheel is at start_position", default=0.0, kw_only=True
    )
    deceleration: Float[Number, ""] = number(
        "m/s^2", "constant deceleration from entry_time", default=0.0, kw_only=True
    )
    times: Float[Number, " point"] | None = number(
        "s", "table: times", INCREASING, default=None, kw_only=True
    )
    positions: Float[Number, " point"] | None = number(
        "m", "table: positions of the first wheel", default=None, kw_only=True
    )
    start_position: Float[Number, ""] | None = number(
        "m",
        "position of the first wheel at entry_time, before the beam",
        default=None,
        kw_only=True,
    )
    eccentricity: Float[Number, ""] | None = number(
        "m", "distance left of the axis of the beam, looking right", default=None, kw_only=True
    )


class AbstractStandingLoad(AbstractLoad):
    """Load that travels as others do, or stays at a `position` (m) from the entry time on."""

    position: eqx.AbstractVar[Float[Array, ""] | None]

    def trajectory(self, length):
        if self.position is None:
            return super().trajectory(length)
        return StandingTrajectory(self.position, self.entry_time, length)

    def validate(self, address):
        if self.position is None:
            return super().validate(address)
        for name in ("speed", "times", "start_position"):
            if getattr(self, name) is not None:
                return f"{address} has both position and {name}; leave one out"
        return None


def wheel_distances(load: Any, vehicle: VehicleModel) -> Float[Array, " wheel"]:
    """Distances (m) of all wheels of a load or an absorber behind its first one, given vehicles."""
    return (load.spacings()[:, None] + vehicle.offsets).reshape(-1)


class AbstractRowLoad(AbstractVehicleLoad):
    """`count` vehicles in a row, the first wheels of neighbours `spacing` apart."""

    count: int = fields.count("number of vehicles in a row", default=1, kw_only=True)
    spacing: Float[Number, ""] | None = number(
        "m", "distance from vehicle to vehicle", NOT_NEGATIVE, default=None, kw_only=True
    )

    def row_spacing(self) -> Float[Array, ""] | None:
        """Distance (m) between the first wheels of neighbours; None if it is not given."""
        return self.spacing

    def spacings(self) -> Float[Array, " vehicle"]:
        if self.count == 1:
            return xp.zeros(1)
        return xp.arange(self.count) * self.row_spacing()

    def validate(self, address):
        if self.count > 1 and self.row_spacing() is None:
            return (
                f"{address}.spacing is missing; give the distance in m from vehicle to vehicle of"
                f" the {self.count}"
            )
        return super().validate(address)

    def overlap_error(self, address: str, wheelbase: Float[Array, ""], name: str) -> str | None:
        """Error message if a vehicle of a wheelbase (m) is longer than the spacing, or None."""
        spacing = self.row_spacing()
        if self.count == 1 or not (is_concrete(spacing) and is_concrete(wheelbase)):
            return None
        if concrete(spacing) > concrete(wheelbase):
            return None
        return (
            f"{address}.spacing must exceed the wheelbase of the {name},"
            f" {concrete(wheelbase):g} m; it is {concrete(spacing):g} m: give a larger one"
        )


def positive_error(address: str, part: Any, names: tuple[str, ...], reason: str) -> str | None:
    """Error of the first number among some fields of a part that is not positive."""
    for name in names:
        value = getattr(part, name)
        if value is None or not is_concrete(value):
            continue
        numbers = np.atleast_1d(concrete(value))
        wrong = np.flatnonzero(numbers <= 0)
        if wrong.size:
            entry = f".{wrong[0]}" if np.ndim(value) else ""
            return f"{address}.{name}{entry} must be positive: {reason}"
    return None


def length_error(address: str, part: Any, first: str, names: tuple[str, ...]) -> str | None:
    """Error of the first list among some fields that is not as long as that of the field first."""
    expected = np.shape(getattr(part, first))[0]
    for name in names:
        value = getattr(part, name)
        if value is None or not np.ndim(value) or np.shape(value)[0] == expected:
            continue
        return (
            f"{address}.{name} has {counted(np.shape(value)[0], 'entry', 'entries')} and"
            f" {first} has {expected}; give one for each axle, front first"
        )
    return None


def static_load_error(address: str, vehicle: VehicleModel) -> str | None:
    """Error of a vehicle without static equilibrium, or with a wheel that presses on nothing.

    `vehicle` is that of any gravity.
    """
    if not is_concrete(vehicle.static_loads):
        return None
    stiffness = concrete(vehicle.full_stiffness)
    scale = np.sqrt(np.abs(np.diag(stiffness)))
    held = np.all(scale > 0) and np.linalg.matrix_rank(stiffness / np.outer(scale, scale)) == len(
        scale
    )
    if not held:
        return (
            f"{address} has no static equilibrium: its springs hold {_loose(vehicle)} in no"
            " place; add a spring or an axle"
        )
    loads = concrete(vehicle.static_loads)
    for i, load in enumerate(loads):
        if load <= _LOAD_TOLERANCE * np.mean(np.abs(loads)):
            sign = "a negative static load" if load < 0 else "no static load"
            return (
                f"axle {i + 1} of {address} would carry {sign}; move it, or the centres of mass,"
                " so that every axle is pressed down"
            )
    return None


def _loose(vehicle: VehicleModel) -> str:
    """Names of the degrees of freedom that move most in a motion without spring resistance."""
    values, vectors = np.linalg.eigh(concrete(vehicle.full_stiffness))
    return repr(vehicle.names[int(np.argmax(np.abs(vectors[:, 0])))])


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
