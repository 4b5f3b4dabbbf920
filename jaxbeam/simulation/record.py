"""Record of one simulated run: histories, section forces, peaks, error; extremes along the beam."""

import enum
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case
from jaxbeam.case.display import with_prefix
from jaxbeam.case.fields import concrete, is_concrete, real_numbers, refuse_traced, refuses_traced
from jaxbeam.case.sensors import QUANTITIES, Sensor
from jaxbeam.model.along_beam import moving_positions, refined, sections
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modes import Modes
from jaxbeam.model.output_rows import sensor_history
from jaxbeam.model.sensor_signals import (
    VehicleMotion,
    relative_to_beam,
    sensor_readings,
    vehicle_readings,
)
from jaxbeam.model.static_correction import Motion
from jaxbeam.runtime.arrays import Array, Module, any_traced, set_at, take, to_numpy, xp
from jaxbeam.runtime.printer import TableViews, labelled_dataset
from jaxbeam.simulation import section_forces
from jaxbeam.simulation.errors import Extremes, chosen_samples, truncation_errors
from jaxbeam.simulation.section_forces import history
from jaxbeam.simulation.views import Flights, RecordViews, contact_sentence, flights_sentence

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

MAX_ENTRIES = 4_000_000  # of the influence of all loads on all positions and modes in one block


class RecordEnvelope(TableViews, Module):
    """Smallest and largest values of a quantity at positions (m), from the samples of a record.

    Values are in the unit of the quantity; with each are its time (s) and the positions of the
    loads then (m, NaN off the beam), and the value of the `coincident` quantity there and then, if
    one was asked for: of a shear force, that on the side on which it is larger.
    """

    positions: Float[Array, " position"]
    smallest: Float[Array, " position"]
    smallest_time: Float[Array, " position"]
    smallest_load_position: Float[Array, "position load"]
    largest: Float[Array, " position"]
    largest_time: Float[Array, " position"]
    largest_load_position: Float[Array, "position load"]
    quantity: str = eqx.field(static=True)
    smallest_coincident: Float[Array, " position"] | None = None
    largest_coincident: Float[Array, " position"] | None = None
    coincident: str = eqx.field(static=True, default="")

    @property
    def headline(self) -> str:
        """The smallest and largest value of all, and where they are."""
        return envelope_headline(self.quantity, self.positions, self.smallest, self.largest)

    @property
    @refuses_traced("a table")
    def columns(self) -> dict[str, np.ndarray]:
        """Position (m), smallest and largest value with their times (s), by head."""
        head = with_unit(self.quantity)
        columns = {
            "position (m)": np.asarray(self.positions),
            f"smallest {head}": np.asarray(self.smallest),
            "time of smallest (s)": np.asarray(self.smallest_time),
            f"largest {head}": np.asarray(self.largest),
            "time of largest (s)": np.asarray(self.largest_time),
        }
        if self.coincident:
            other = with_unit(self.coincident)
            columns[f"{other} at smallest"] = np.asarray(self.smallest_coincident)
            columns[f"{other} at largest"] = np.asarray(self.largest_coincident)
        return columns

    @refuses_traced("a dataset")
    def to_xarray(self) -> "xarray.Dataset":
        """Labelled dataset with units."""
        unit, words = QUANTITIES[self.quantity].unit, self.quantity
        variables = {}
        for side in ("smallest", "largest"):
            values = (getattr(self, f"{side}{part}") for part in ("", "_time", "_load_position"))
            value, time, place = map(np.asarray, values)
            variables |= {
                side: ("position", value, {"units": unit, "long_name": f"{side} {words}"}),
                f"{side}_time": ("position", time, {"units": "s"}),
                f"{side}_load_position": (("position", "load"), place, {"units": "m"}),
            }
            if self.coincident:
                other = np.asarray(getattr(self, f"{side}_coincident"))
                attributes = {
                    "units": QUANTITIES[self.coincident].unit,
                    "long_name": f"{self.coincident} at the {side} {words}",
                }
                variables[f"{side}_coincident"] = ("position", other, attributes)
        x = ("position", np.asarray(self.positions), {"units": "m"})
        return labelled_dataset(variables, {"position": x}, {"quantity": self.quantity})


def with_unit(quantity: str) -> str:
    """A quantity with its unit, as the head of a column: "moment (N m)"."""
    unit = QUANTITIES[quantity].unit
    return quantity if unit == "1" else f"{quantity} ({unit})"


def envelope_headline(quantity: str, positions, smallest, largest) -> str:
    """Sentence on the extremes of an envelope along the beam, and their positions (m)."""
    unit = QUANTITIES[quantity].unit
    low, high = np.argmin(smallest), np.argmax(largest)
    return (
        f"Envelope of {quantity}: smallest {with_prefix(smallest[low], unit)} at"
        f" {positions[low]:.6g} m, largest {with_prefix(largest[high], unit)} at"
        f" {positions[high]:.6g} m"
    )


def record_envelope(
    case: Case,
    modes: Modes,
    motion: Motion,
    times: Float[Array, " time"],
    quantity: str,
    positions: Float[Array, " position"] | None = None,
    fibre_distance=None,
    section_modulus=None,
    coincident: str = "",
) -> RecordEnvelope:
    """Envelope of a quantity at positions (m), by default those of `refined`.

    See `Record.envelope`. Raises ValueError as `history` does.
    """
    parameters = fibre_distance, section_modulus
    if not any_traced(case, modes, motion, times):
        case, modes, motion, times = to_numpy((case, modes, motion, times))

    def at(x):
        return _envelope_at(case, modes, motion, times, x, quantity, coincident, parameters)

    def curves(found: RecordEnvelope):
        values = xp.stack([-found.smallest, found.largest], axis=-1)
        places = found.smallest_load_position, found.largest_load_position
        return values, xp.max(xp.abs(values)), tuple(map(np.asarray, places))

    numbers = case, modes, motion, times, parameters
    leaves = jax.tree.leaves(numbers)
    if positions is None and any_traced(leaves) and all(map(is_concrete, leaves)):
        # Positions of the extremes of the concrete numbers, where the values are differentiated.
        plain = jax.tree.map(lambda n: concrete(n) if any_traced(n) else n, numbers)
        own_case, own_modes, own_motion, own_times, (fibre, modulus) = plain
        run = own_case, own_modes, own_motion, own_times
        found = record_envelope(*run, quantity, None, fibre, modulus)
        at_extremes = [
            motion.load_position[np.searchsorted(own_times, time)]
            for time in (found.smallest_time, found.largest_time)
        ]
        load_places = xp.concatenate(at_extremes, axis=1).T
        positions, _ = moving_positions(case, np.asarray(found.positions), list(load_places))
    if positions is not None:
        return at(real_numbers("positions", positions, "m", "positions"))
    return refined(case, at, curves)[1]


def _envelope_at(case, modes, motion, times, x, quantity, coincident, parameters):
    """Envelope at positions x (m), in blocks of samples."""
    points, at_coincident = sections(case, x, quantity), sections(case, x, coincident or quantity)
    size = max(1, len(case.loads), motion.load_position.shape[1])
    size *= points.points.shape[0] + motion.coordinates.shape[1]
    count = -(-times.shape[0] * size // MAX_ENTRIES)
    found: dict[float, tuple] = {}
    for block in np.array_split(np.arange(times.shape[0]), min(count, times.shape[0])):
        own = Motion(*(part[block] for part in motion))
        values = history(case, modes, own, points.points, quantity, *parameters)
        other = None
        if coincident:
            every = history(case, modes, own, at_coincident.points, coincident, *parameters)
            most, least = at_coincident.largest(every), at_coincident.smallest(every)
            other = xp.where(xp.abs(most) >= xp.abs(least), most, least)
        for sign, curve in ((-1.0, -points.smallest(values)), (1.0, points.largest(values))):
            new = _extremes(curve, times[block], own, other)
            found[sign] = _larger(found[sign], new) if sign in found else new
    (low, *of_low), (high, *of_high) = found[-1.0], found[1.0]
    others = (of_low.pop(), of_high.pop()) if coincident else (None, None)
    return RecordEnvelope(
        *(x, -low, *of_low, high, *of_high, quantity),
        smallest_coincident=others[0],
        largest_coincident=others[1],
        coincident=coincident,
    )


def _extremes(values, times, motion: Motion, other) -> tuple:
    """Largest of values (time, position), its time, and the positions of the loads then.

    Followed by another quantity (time, position) there and then, unless it is None.
    """
    index = xp.argmax(values, axis=0)
    found = (xp.take_along_axis(values, index[None], axis=0)[0], take(times, index))
    found += (take(motion.load_position, index),)
    return found if other is None else (*found, xp.take_along_axis(other, index[None], axis=0)[0])


def _larger(one: tuple, other: tuple) -> tuple:
    """The larger of two results of `_extremes`, at each position."""
    is_larger = other[0] > one[0]
    return tuple(
        xp.where(is_larger[:, None] if a.ndim == 2 else is_larger, b, a)
        for a, b in zip(one, other, strict=True)
    )


class Result(enum.IntFlag):
    """Flags of what is wrong with a run, combined in one number that programs can return.

    `CONTACT_LOST`: a contact force is tensile, at which the load would lift off. `STEPS_TOO_LONG`:
    the error estimate is above the tolerance, or NaN. `DIVERGED`: the closed loop has grown beyond
    all bounds. `OUT_OF_RANGE`: a number is outside of the range for which the steps were chosen.

    >>> import jaxbeam as jb
    >>> print(jb.Result.DIVERGED in jb.Result(5), jb.Result.OUT_OF_RANGE in jb.Result(5))
    True False
    """

    CONTACT_LOST = 1
    STEPS_TOO_LONG = 2
    DIVERGED = 4
    OUT_OF_RANGE = 8


class Record(RecordViews):
    """Record of one simulated run.

    Deflection is positive upwards. Samples at an entry or exit of a load are those just after.
    Loads are counted by their wheels. `load_position` (m) is NaN while a wheel is off the beam,
    `contact_force` (N, positive under compression) zero, unless it is the wheel of a vehicle, which
    presses on the ground. `smallest` and `largest` values of the quantities of the sensors are in
    their units. The `bodies` of vehicles have displacements in m (or rad) from static equilibrium,
    positive upwards. Peaks are those in continuous time. `contact_lost_time` (s) and
    `contact_lost_position` (m) are those of the first negative contact force, which the bilateral
    model allows; NaN without one. On rough profiles `lowest_contact_force` (N) is within 2e-4 of
    the largest contact force, which the error estimates do not hold. With unilateral contact they
    are those of the first flight, and `flights` are all of them, else None. `command` is that of
    the actuators, within their limits; at a change, the one just after. `failures` counts the steps
    of the controller so far without a solution of its optimisation. If the closed loop diverges,
    which its growth shows (see `jaxbeam.simulation.integrator.inputs`), the samples are NaN from
    then on, and so are the peaks. `error_estimate`, of steps and peaks, is relative to the largest
    deflection, `step_errors` to the largest value of what each sensor measures; both have no
    derivatives, which `grad` refuses and `jvp` gives as NaN. `controller_readings` are the readings
    that a sampled controller has received, None without one; `acting_command` are the commands
    behind hysteresis and creep of the actuators, None if no actuator has any. `peak_stroke` (m) and
    `peak_absorber_force` (N) are the largest absolute ones of each absorber. `result` is zero, or
    the sum of what is wrong with the run (see `Result`).

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02),
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=1.0)],
    ...     run=jb.Run(0.6, sample_rate=100.0),
    ... )
    >>> record = jb.simulate(case)
    >>> print(record.times.size, record.deflection.shape)
    61 (61, 1)
    >>> print(record.verdict.split(";")[0])
    every load presses on the beam throughout
    """

    case: Case
    modes: Modes
    times: Float[Array, " time"]
    coordinates: Float[Array, "time mode"]
    rates: Float[Array, "time mode"]
    accelerations: Float[Array, "time mode"]
    load_position: Float[Array, "time load"]
    contact_force: Float[Array, "time load"]
    command: Float[Array, "time actuator"]
    failures: Float[Array, " time"]
    peak_deflection: Float[Array, " sensor"]
    peak_time: Float[Array, " sensor"]
    smallest: Float[Array, " sensor"]
    smallest_time: Float[Array, " sensor"]
    largest: Float[Array, " sensor"]
    largest_time: Float[Array, " sensor"]
    lowest_contact_force: Float[Array, " load"]
    contact_lost_time: Float[Array, " load"]
    contact_lost_position: Float[Array, " load"]
    body_displacement: Float[Array, "time body"]
    body_velocity: Float[Array, "time body"]
    body_acceleration: Float[Array, "time body"]
    error_estimate: Float[Array, ""]
    step_errors: Float[Array, " sensor"]
    peak_stroke: Float[Array, " absorber"]
    peak_absorber_force: Float[Array, " absorber"]
    steps: int = eqx.field(static=True)
    controller_readings: Float[Array, "time sensor"] | None = None
    acting_command: Float[Array, "time actuator"] | None = None
    result: Int[Array, ""] | None = None
    flights: Flights | None = None

    @property
    def loads(self) -> LoadSet:
        """Wheels and vehicles of the loads of the case, the absorbers behind them."""
        return load_set(self.case)

    @property
    def bodies(self) -> list[str]:
        """Names of the degrees of freedom of vehicles and absorbers: "loads.0 vehicle 2 body"."""
        loads, names = self.loads, []
        for group in loads.wheels.vehicles:
            number = loads.load_of_wheel[group.first_wheel]
            absorber = number - len(self.case.loads)
            load = f"loads.{number}" if absorber < 0 else f"absorbers.{absorber}"
            for i in range(group.count):
                vehicle = load if group.count == 1 else f"{load} vehicle {i}"
                names += [f"{vehicle} {name}" for name in group.names]
        return names

    @property
    def motion(self) -> Motion:
        """Motion of the modes, contact forces and commands."""
        return Motion(
            self.coordinates,
            self.rates,
            self.accelerations,
            self.load_position,
            self.contact_force,
            self.command if self.acting_command is None else self.acting_command,
        )

    @checks_classes
    def at(
        self, x, quantity: str = "deflection", fibre_distance=None, section_modulus=None
    ) -> Float[Array, "time ..."]:
        """History of a quantity at positions x (m) of any shape: (time, *shape of x), in SI units.

        Strain is that of the fibre at `fibre_distance` z (m) above the neutral axis, -z w_xx;
        stress the moment over the `section_modulus` (m^3). Curvature, strain and section forces are
        statically corrected, hence right with few modes (see `corrected_history`). Moments, shear
        forces and stresses include those of settled supports; sensors and all other quantities are
        zero at the start of a run. Raises ValueError for an unknown quantity, strain without a
        fibre distance, or stress without a section modulus.
        """
        parameters = fibre_distance, section_modulus
        x = real_numbers("x", x, "m", "positions")
        return section_forces.history(self.case, self.modes, self.motion, x, quantity, *parameters)

    def bending_moment(self, x) -> Float[Array, "time ..."]:
        """Bending moment at positions x (m) in N m, positive where the beam sags: E I w_xx."""
        return self.at(x, "moment")

    @checks_classes
    def shear_force(self, x, side: str = "right") -> Float[Array, "time ..."]:
        """Shear force dM/dx at positions x (m) in N, just "right" or "left" of each.

        It jumps at loads and supports: by a contact force down, by a reaction up. At the ends of
        the beam it is that within. Raises ValueError for another side.
        """
        x = real_numbers("x", x, "m", "positions")
        return section_forces.shear_force(self.case, self.modes, self.motion, x, side)

    @property
    def reactions(self) -> Float[Array, "time support"]:
        """Reactions of ends and supports in N, positive upwards, at `support_positions`."""
        return section_forces.reactions(self.case, self.modes, self.motion)

    @property
    def support_positions(self) -> Float[Array, " support"]:
        """Positions (m) of held ends and supports, from left to right."""
        return section_forces.support_positions(self.case, self.modes)

    @checks_classes
    def envelope(
        self,
        quantity: str = "moment",
        positions=None,
        fibre_distance=None,
        section_modulus=None,
        coincident: str = "",
    ) -> RecordEnvelope:
        """Smallest and largest values of a quantity at positions (m), with times and loads.

        From the samples, free vibration included; what jumps at a position is taken on both sides.
        By default positions are ends, supports, hinges, changes of section, actuators, sensors,
        loads that stand, 100 equal steps, and as many more as it takes for the smallest and the
        largest value along the beam to change by less than 1e-4 (of these there are none under
        `jit` and `vmap`, as their number must be concrete). The quantities are those of `at`; a
        moment has its peak as a load passes, so that a load should move by a small part of the
        length between samples. With each value is that of another, `coincident` quantity at the
        same place and time, if one is named. Raises ValueError as `at` does.
        """
        parameters = positions, fibre_distance, section_modulus, coincident
        return record_envelope(
            self.case, self.modes, self.motion, self.times, quantity, *parameters
        )

    @property
    def sensor_values(self) -> Float[Array, "time sensor"]:
        """True quantity of each sensor in its SI unit: without offset, filters and noise."""
        parts = self.case, self.modes, self.motion
        columns = [sensor_history(*parts, sensor) for sensor in self.case.sensors]
        return xp.array(columns).reshape(-1, self.times.shape[0]).T

    @property
    def extremes(self) -> Extremes:
        """Smallest and largest value of the quantity of each sensor, with their times (s).

        Those in continuous time, between samples too; zero, at rest, is among the values.
        """
        return Extremes(self.smallest, self.smallest_time, self.largest, self.largest_time)

    @property
    def truncation_errors(self) -> Float[Array, " sensor"]:
        """Estimated effect of the modes left out, relative to the largest value at each sensor.

        See `jaxbeam.simulation.errors`: of deflections the static correction, of others the
        dynamic part of the three highest modes, from up to 400 samples. `step_errors` are
        those of the time steps. NaN where there is no estimate.
        """
        chosen = chosen_samples(self.times.shape[0])
        motion = Motion(*(part[chosen] for part in self.motion))
        return truncation_errors(self.case, self.modes, motion)

    def _at_sensors(self, quantity: str) -> Float[Array, "time sensor"]:
        values = self.at(self.case.sensor_positions, quantity)
        for i, sensor in enumerate(self.case.sensors):
            if sensor.eccentricity is not None:
                there = Sensor(sensor.position, quantity, eccentricity=sensor.eccentricity)
                own = sensor_history(self.case, self.modes, self.motion, there)
                values = set_at(values, np.s_[:, i], own)
        return values

    @property
    def deflection(self) -> Float[Array, "time sensor"]:
        """Deflection at the positions of the sensors in m."""
        return self._at_sensors("deflection")

    @property
    def velocity(self) -> Float[Array, "time sensor"]:
        """Velocity at the sensors in m/s."""
        return self._at_sensors("velocity")

    @property
    def acceleration(self) -> Float[Array, "time sensor"]:
        """Acceleration at the sensors in m/s^2."""
        return self._at_sensors("acceleration")

    @property
    def slope(self) -> Float[Array, "time sensor"]:
        """Slope of the axis at the sensors in rad."""
        return self.at(self.case.sensor_positions, "slope")

    @property
    def strain(self) -> Float[Array, "time sensor"]:
        """Bending strain at the sensors; NaN at those without a fibre distance."""
        columns = [
            self.at(s.position, "strain", xp.nan if s.fibre_distance is None else s.fibre_distance)
            for s in self.case.sensors
        ]
        return xp.array(columns).reshape(-1, self.times.shape[0]).T

    @property
    def measured(self) -> Float[Array, "time sensor"]:
        """Readings of the sensors in the SI units of their quantities, with filters and noise.

        With a sampled controller these are its readings; otherwise sensors without a sampling
        period of their own sample at `times`.

        Raises ValueError if these times do not suit a filter (see `sensor_readings`).
        """
        if self.controller_readings is not None:
            return self.controller_readings
        return sensor_readings(self.case, self.modes, self.motion, self.times, noisy=True)

    @property
    def vehicle_readings(self) -> Float[Array, "time vehicle_sensor"]:
        """Readings of the sensors on vehicles and absorbers in SI units, with filters and noise.

        Raises ValueError if the times do not suit a filter.
        """
        motion = self.body_displacement, self.body_velocity, self.body_acceleration
        vehicles = VehicleMotion(*motion)
        return vehicle_readings(self.case, vehicles, self.stroke, self.times, noisy=True)

    @property
    def stroke(self) -> Float[Array, "time absorber"]:
        """Motion (m) of the bodies of absorbers relative to the beam, positive upwards."""
        return relative_to_beam(self.case, self.modes, self.body_displacement, self.coordinates)

    @property
    def stroke_rate(self) -> Float[Array, "time absorber"]:
        """Rate (m/s) of the stroke."""
        return relative_to_beam(self.case, self.modes, self.body_velocity, self.rates)

    @property
    def absorber_force(self) -> Float[Array, "time absorber"]:
        """Forces (N) of absorbers on the beam, positive downwards, their weight left out."""
        return self.contact_force[:, self.contact_force.shape[1] - len(self.case.absorbers) :]

    @property
    def absorber_energy(self) -> Float[Array, "time absorber"]:
        """Energy (J) that the damper of each absorber has dissipated, by the trapezoidal rule."""
        if not self.case.absorbers:
            return self.stroke
        power = xp.stack([one.damper for one in self.case.absorbers]) * self.stroke_rate**2
        steps = xp.diff(self.times)[:, None] * (power[1:] + power[:-1]) / 2
        return xp.concatenate([xp.zeros((1, power.shape[1])), xp.cumsum(steps, axis=0)])

    @property
    def saturated(self) -> Bool[Array, "time actuator"]:
        """Whether each command is at a limit of its actuator, to 1e-9 of its range."""
        columns = [xp.zeros(self.times.shape, bool) for _ in self.case.actuators]
        for i, actuator in enumerate(self.case.actuators):
            limits, command = actuator.command_limits(), self.command[:, i]
            if limits is not None:
                rounding = 1e-9 * (limits[1] - limits[0])
                columns[i] = (command <= limits[0] + rounding) | (command >= limits[1] - rounding)
        return xp.array(columns, bool).reshape(len(columns), self.times.shape[0]).T

    @property
    def peak_command(self) -> Float[Array, " actuator"]:
        """Largest absolute command among the samples."""
        return xp.max(xp.abs(self.command), axis=0, initial=0.0)

    @property
    def effort(self) -> Float[Array, " actuator"]:
        """Integral of the squared command over the run (command^2 s), by the trapezoidal rule."""
        with np.errstate(over="ignore"):  # of a loop that diverges it is infinite
            return xp.trapezoid(self.command**2, self.times, axis=0)

    @property
    def diverged_time(self) -> Float[Array, ""]:
        """Time (s) of the first sample after the closed loop diverged, NaN if it did not."""
        diverged = xp.any(xp.isnan(self.coordinates), axis=1)
        return xp.where(xp.any(diverged), self.times[xp.argmax(diverged)], xp.nan)

    def _stroke_sentences(self) -> list[str]:
        """Sentences on absorbers whose stroke exceeds the largest allowed."""
        found = []
        for i, absorber in enumerate(self.case.absorbers):
            largest, stroke = absorber.max_stroke, float(concrete(self.peak_stroke[i]))
            if largest is not None and stroke > (limit := float(concrete(largest))):
                found.append(f"the stroke of absorber {i} is {stroke:.4g} m, above {limit:.4g} m")
        return found

    def _size_sentences(self) -> list[str]:
        """Sentences on deflections larger than any beam can have, as of an unstable loop."""
        largest = np.abs(np.asarray(concrete(self.deflection))).max(initial=0.0)
        ratio = float(largest / concrete(self.case.beam.length))
        if not ratio > 1:
            return []
        loop = "" if self.case.controller is None else ", and the stability of the loop"
        return [
            f"the deflection reaches {largest:.4g} m, {ratio:.3g} times the length of the beam, for"
            f" which the model does not hold: check units{loop}"
        ]

    @property
    def verdict(self) -> str:
        """Sentence on divergence, size, contact, steps of the controller that failed, and error."""
        if not is_concrete(self.coordinates):  # numbers that `grad` traces are concrete
            refuse_traced("a verdict", "read it outside jit and vmap", self)
        diverged = float(concrete(self.diverged_time))
        if np.isfinite(diverged):
            return (
                f"the control loop diverges: the deflection has grown beyond all bounds by"
                f" t = {diverged:.4g} s; lower the gains, or shorten period and delay"
            )
        contact = self.contact_lost_time, self.contact_lost_position, self.lowest_contact_force
        if self.flights is None or not self.flights.wheel.size:
            contact = (np.asarray(concrete(part)) for part in contact)
            parts = [contact_sentence(self.case, self.loads, *contact)]
        else:
            parts = [flights_sentence(self.case, self.loads, self.flights)]
        parts += self._stroke_sentences() + self._size_sentences()
        failures = int(concrete(self.failures)[-1])
        if failures:
            parts.append(f"the controller found no solution in {failures} of its steps")
        error = float(concrete(self.error_estimate))
        parts.append(
            "the error of the steps is unknown, as the plan is of other numbers"
            if np.isnan(error)
            else f"estimated error of the steps {error:.1e} of the largest deflection"
        )
        return "; ".join(parts)
