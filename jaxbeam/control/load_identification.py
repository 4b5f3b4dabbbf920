"""Identification of mass and speed of a load from the readings, on line.

Identification is by least squares on static influence lines, sample by sample. The position of the
load follows from two gate times at constant speed, or from the deflections themselves: their ratio
at two sensors or more depends on the position of a load at rest, not on its mass.

In a simulation the gate times are computed from the trajectory of the load.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import Measurement, Time
from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import POSITIVE, concrete, deciding, is_concrete, number
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.trajectory import SAME_FRACTION, has_come
from jaxbeam.control.estimation.observability import deflection_outputs
from jaxbeam.control.estimation.observer import sensor_offsets
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.state_space import Plant, state_space
from jaxbeam.runtime.arrays import Array, Module, Number, scan, take, xp
from jaxbeam.runtime.compiling import compiled_if_traced

# A line through identified positions is accepted when their scatter is at most this fraction of the
# distance over which they are identified, and their weights add up to this many times the largest
# weight: at first the beam lags, and identified positions stand still or jump.
MIN_TRAVEL_SPREAD, MIN_EFFECTIVE_SAMPLES = 0.1, 8
INFLUENCE_ROUNDING = 1e-20  # of the largest squared influence; smaller ones are rounding errors


class LoadEstimate(NamedTuple):
    """Mass (kg), speed (m/s, negative to the left) and entry time (s) of a load.

    Entry time and speed are meaningless until `speed_identified`, the mass until `mass_identified`.
    """

    mass: Float[Array, ""]
    speed: Float[Array, ""]
    entry_time: Float[Array, ""]
    speed_identified: Bool[Array, ""]
    mass_identified: Bool[Array, ""]


class AbstractLoadSource(Module):
    """Source of mass, speed and entry time of the load for a scheduled law, with its own state."""

    def initial_state(self) -> Any:
        """State at the start of a run."""
        return ()

    @abc.abstractmethod
    def update(self, state: Any, measurement: Measurement, t: Time) -> tuple[LoadEstimate, Any]:
        """Estimate at a sample at t (s), and the next state."""


class GivenLoad(AbstractLoadSource):
    """Load with mass (kg), speed (m/s) and entry time (s) given beforehand."""

    mass: Float[Array, ""]
    speed: Float[Array, ""]
    entry_time: Float[Array, ""]

    def update(self, state, measurement, t):
        true = xp.ones((), bool)
        return LoadEstimate(self.mass, self.speed, self.entry_time, true, true), state


def given_load(load: AbstractLoad, gravity: Float[Array, ""]) -> GivenLoad:
    """Load of a case as its own source: mass, speed and entry time as given there.

    A vehicle has its total mass and enters with its first wheel; speed and entry time are NaN for a
    table of positions.
    """
    numbers = load.total_mass(gravity), load.speed, load.entry_time
    return GivenLoad(*(xp.asarray(xp.nan if x is None else x) for x in numbers))


class AbstractLoadIdentifier(AbstractLoadSource):
    """Least-squares identification of a load from deflections; its state are sums over samples.

    `influence_lines` (m/N) are deflections at the sensors `sensor_indices` under a unit force at
    positions spaced evenly along the beam, by the modes of the design model (exact ones:
    `jb.influence_line`); `static_lift` is the static deflection there per unit of each command,
    `offset` the offset of the readings (m). `until` is the fraction of the crossing up to which
    samples are used. Samples at which a deflection is missing are left out.
    """

    without_reading: ClassVar[str] = (
        "Samples at which a deflection is missing do not identify the load."
    )

    length: Float[Array, ""]
    gravity: Float[Array, ""]
    influence_lines: Float[Array, "sensor position"]
    static_lift: Float[Array, "sensor actuator"]
    offset: Float[Array, " sensor"]
    until: Float[Array, ""]
    sensor_indices: tuple[int, ...] = eqx.field(static=True)

    @abc.abstractmethod
    def estimate(self, sums: Float[Array, " sum"], t: Time) -> LoadEstimate:
        """Estimate from the sums, at t (s)."""

    @abc.abstractmethod
    def increments(
        self, sums: Float[Array, " sum"], deflections: Float[Array, " sensor"], t: Time
    ) -> Float[Array, " sum"]:
        """Increments of the sums by the deflections (m) due to the load alone, at t (s)."""

    def update(self, state, measurement, t):
        readings = measurement.readings[np.array(self.sensor_indices)] - self.offset
        deflections = readings - self.static_lift @ measurement.command
        increments = self.increments(state, deflections, t)
        sums = state + xp.where(measurement.complete(self.sensor_indices), increments, 0.0)
        return self.estimate(sums, t), sums

    def fitted_mass(self, cross_sum, square_sum) -> Float[Array, ""]:
        """Mass (kg) by least squares, sum a y / (g sum a^2) with influence a, reading y; or 0."""
        observable = square_sum > 0
        weight = xp.where(observable, cross_sum / xp.where(observable, square_sum, 1.0), 0.0)
        return weight / self.gravity


class GateIdentifier(AbstractLoadIdentifier):
    """Speed and entry time from two gates, mass from deflections after the second gate.

    `gates` (m) are passed at `gate_times` (s). The sums are those of a y and a^2, with the
    influence a at the position of the load and the deflection y.
    """

    gates: Float[Array, "2"]
    gate_times: Float[Array, "2"]

    def initial_state(self):
        return xp.zeros(2)

    def update(self, state, measurement, t):
        # Each load that passes the first gate begins new sums.
        return super().update(xp.where(has_come(self.gate_times[1], t), state, 0.0), measurement, t)

    @property
    def speed(self) -> Float[Array, ""]:
        """Speed (m/s), negative to the left."""
        return xp.diff(self.gates)[0] / xp.diff(self.gate_times)[0]

    @property
    def entry_time(self) -> Float[Array, ""]:
        """Time (s) at which the load enters the beam at constant speed."""
        start = xp.where(self.speed < 0, self.length, 0.0)
        return self.gate_times[1] + (start - self.gates[1]) / self.speed

    def crossed_fraction(self, t: Time) -> Float[Array, ""]:
        """Fraction of the crossing that is completed at t (s)."""
        return (t - self.entry_time) * xp.abs(self.speed) / self.length

    def estimate(self, sums, t):
        speed_identified = has_come(self.gate_times[1], t)
        until = self.until - SAME_FRACTION
        mass_identified = speed_identified & (self.crossed_fraction(t) >= until)
        mass = self.fitted_mass(*sums)
        return LoadEstimate(mass, self.speed, self.entry_time, speed_identified, mass_identified)

    def increments(self, sums, deflections, t):
        crossed = self.crossed_fraction(t)
        *_, speed_identified, mass_identified = self.estimate(sums, t)
        relative_position = xp.where(self.speed < 0, 1 - crossed, crossed)
        positions = np.linspace(0, 1, self.influence_lines.shape[1])
        influence = xp.stack(
            [xp.interp(relative_position, positions, line) for line in self.influence_lines]
        )
        active = speed_identified & ~mass_identified & (crossed > 0)
        return xp.where(active, xp.stack([influence @ deflections, influence @ influence]), 0.0)


class DeflectionIdentifier(AbstractLoadIdentifier):
    """Speed, entry time and mass from deflections that exceed a `threshold` (m).

    At each sample the position x is the one whose influence lines fit the deflections best. Speed
    and entry time follow from a straight line through these positions over time, weighted by the
    fourth power of the size of the deflections. The sums are those of the weights w, of w t, w t^2,
    w x and w t x, of a y and a^2 as in `GateIdentifier`, and the largest w.
    """

    threshold: Float[Array, ""]

    def initial_state(self):
        return xp.zeros(8)

    def estimate(self, sums, t):
        speed, entry_time, determined = self._fitted_line(sums)
        travelled = (t - entry_time) * xp.abs(speed)
        identified = determined & (travelled >= self.until * self.length)
        mass = self.fitted_mass(*sums[5:7])
        return LoadEstimate(mass, speed, entry_time, identified, identified)

    def increments(self, sums, deflections, t):
        position, cross_product, squared_influence = self._best_position(deflections)
        weight = xp.sum(deflections**2) ** 2
        line_sums = weight * xp.stack([xp.ones(()), t, t**2, position, t * position])
        peak_increment = xp.maximum(weight - sums[7], 0.0)
        increments = xp.concatenate(
            [line_sums, xp.stack([cross_product, squared_influence, peak_increment])]
        )
        identified = self.estimate(sums, t).mass_identified
        active = ~identified & (xp.max(xp.abs(deflections)) > self.threshold)
        return xp.where(active, increments, 0.0)

    def _best_position(self, deflections):
        """Position (m) whose influence lines a fit the deflections y best, with a y and a^2 there.

        The maximum of (a y)^2 / a^2 over the positions, refined by a parabola.
        """
        squares = xp.sum(self.influence_lines**2, axis=0)
        products = deflections @ self.influence_lines
        # At a support the lines are zero apart from rounding, whose ratio may fit any deflections.
        observable = squares > INFLUENCE_ROUNDING * xp.max(squares)
        explained = xp.where(observable, products**2 / xp.where(observable, squares, 1.0), 0.0)
        best = xp.clip(xp.argmax(explained), 1, squares.shape[0] - 2)
        left, centre, right = (take(explained, best + k) for k in (-1, 0, 1))
        curvature = left - 2 * centre + right
        concave = curvature < 0
        vertex = xp.where(concave, (left - right) / (2 * xp.where(concave, curvature, -1.0)), 0.0)
        index = best + xp.clip(vertex, -0.5, 0.5)
        position = index * self.length / (squares.shape[0] - 1)
        return position, take(products, best), take(squares, best)

    def _fitted_line(self, sums):
        """Speed (m/s) and entry time (s) of the fitted line, and whether the samples determine it.

        Until they do: one beam length per second, and zero.
        """
        total, t, square, x, product = sums[:5]
        time_variance = total * square - t**2
        determined = time_variance > 1e-9 * total * square
        speed = (total * product - t * x) / xp.where(determined, time_variance, 1.0)
        min_travel = MIN_TRAVEL_SPREAD * self.until * self.length
        determined = (
            determined
            & (speed**2 * time_variance > (min_travel * total) ** 2)
            & (total > MIN_EFFECTIVE_SAMPLES * sums[7])
        )
        speed = xp.where(determined, speed, self.length)
        start = xp.where(speed < 0, self.length, 0.0)
        total = xp.where(determined, total, 1.0)
        entry_time = xp.where(determined, t / total + (start - x / total) / speed, 0.0)
        return speed, entry_time, determined


INFLUENCE_POSITIONS = 201  # load positions along the beam at which influence lines are tabulated


class LoadIdentification(ReprWithUnits):
    """Settings for identifying speed and mass of a load while it crosses.

    The speed follows from two `gates`, which may lie before the beam (at a negative position if the
    load enters at the left), and is assumed to stay constant; or, without gates, from the
    deflections at two sensors or more where they exceed a `threshold`. While the load is on the
    first part of the crossing, `until`, its weight is the one whose static deflections fit the
    readings of the deflection sensors best, less the static deflections due to the commands. The
    beam must not be able to move as a rigid body.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.ScheduledFeedback(
    ...         masses=[0.2, 0.5],
    ...         gains=[[1e3, 3e3]],
    ...         load_identification=jb.LoadIdentification(gates=[-0.1, -0.05]),
    ...         period=0.005,
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.019 mm
    """

    gates: Float[Number, "2"] | None = number(
        "m", "positions of the gates, in the order of passage", default=None
    )
    until: Float[Number, ""] = number(
        "1", "fraction of the crossing after which the mass is identified", POSITIVE, default=0.3
    )
    threshold: Float[Number, ""] | None = number(
        "m", "deflection above which a load is on the beam, without gates", POSITIVE, default=None
    )
    gate_errors: Float[Number, "2"] = number(
        "m", "distance by which each gate is farther along than the law has it", default=(0.0, 0.0)
    )

    def validate(self, case: Any) -> str | None:
        """Error of these settings in a case, as "key must ...", or None."""
        deflection_sensors = sum(sensor.quantity == "deflection" for sensor in case.sensors)
        if not deflection_sensors:
            return "until needs a sensor of deflection; add one"
        if (self.gates is None) == (self.threshold is None):
            return "gates or threshold must be given, and not both"
        if self.gates is None:
            if deflection_sensors < 2:
                return "threshold needs two sensors of deflection or more; add one, or give gates"
            return None
        numbers = (self.gates, self.until, case.beam.length, case.loads[0].speed)
        if not all(is_concrete(value) for value in numbers):
            return None
        gates, until, length, speed = (concrete(value) for value in numbers)
        gate_shares = np.sign(speed) * (gates - (length if speed < 0 else 0.0)) / length
        if gate_shares[1] <= gate_shares[0]:
            return (
                "gates must be two positions, the one that the load passes first before the other"
            )
        if not gate_shares[1] < until <= 1:
            return (
                f"until must be beyond the second gate, at {gate_shares[1]:.3g} of the crossing,"
                " and at most 1"
            )
        return None

    def identifier(self, plant: Plant, design_plant: Plant) -> AbstractLoadIdentifier:
        """Identifier of the first load of a plant, with the deflections of the design plant."""
        system, modes = design_plant.unloaded, design_plant.coordinate_scale.shape[0]
        length, sensor_indices = plant.case.beam.length, deflection_outputs(system)
        positions = length * np.linspace(0, 1, INFLUENCE_POSITIONS)
        shapes = design_plant.modal_model.shapes(positions, (0,))[0]
        response = system.static_response(sensor_indices)
        common = {
            "length": length,
            "gravity": design_plant.case.run.gravity,
            # Weights act downwards, against the deflection.
            "influence_lines": -response[:, modes : 2 * modes]
            @ (design_plant.coordinate_scale[:, None] * shapes.T),
            "static_lift": response @ system.B,
            "offset": sensor_offsets(design_plant)[sensor_indices],
            "until": deciding(self.until, "load_identification.until"),
            "sensor_indices": tuple(int(i) for i in sensor_indices),
        }
        if self.gates is None:
            threshold = deciding(self.threshold, "load_identification.threshold")
            return DeflectionIdentifier(threshold=threshold, **common)
        true_gates = self.gates + self.gate_errors
        gate_times = plant.loads.trajectories[0].passage_times(true_gates)[:2]
        return GateIdentifier(gates=self.gates, gate_times=gate_times, **common)


def identification_error(controller: Any, case: Any) -> str | None:
    """Error of the `load_identification` of a controller in a case, as "key must ...", or None."""
    if controller.load_identification is None:
        return None
    if controller.period is None:
        return "period must be given: load identification acts at samples"
    error = controller.load_identification.validate(case)
    return None if error is None else f"load_identification.{error}"


class IdentifiedLoad(NamedTuple):
    """Identified mass (kg) and speed (m/s) of a load, and their relative errors."""

    mass: float
    speed: float
    mass_error: float
    speed_error: float


def identified_load(record: Any, settings: LoadIdentification) -> IdentifiedLoad:
    """Mass and speed of the first load, identified from the readings and commands of a record.

    The same as in the control loop if the record has a sample at every sample of the controller,
    and commands change at these samples only. Errors refer to the speed at entry.

    Raises ValueError for settings that do not suit the case.

    >>> import jaxbeam as jb
    >>> from jaxbeam.control.load_identification import identified_load
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.ScheduledFeedback(
    ...         masses=[0.2, 0.5], gains=[[1e3, 3e3]], period=0.005
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> settings = jb.LoadIdentification(gates=[-0.1, -0.05])
    >>> found = identified_load(jb.simulate(case), settings)
    >>> print(f"{found.mass:.2f} kg at {found.speed:.2f} m/s")
    0.41 kg at 4.00 m/s
    """
    case = record.case
    error = settings.validate(case)
    if error is not None:
        raise ValueError(f"load_identification.{error}")
    mass, speed = (float(value) for value in _replay(settings, case, mesh_layout(case), record))
    load = case.loads[0]
    true_mass, true_speed = float(load.total_mass(case.run.gravity)), float(load.speed)
    return IdentifiedLoad(mass, speed, mass / true_mass - 1, speed / true_speed - 1)


@compiled_if_traced
def _replay(settings: LoadIdentification, case: Case, layout, record):
    """Mass (kg) and speed (m/s) after the last sample of a record."""
    plant = state_space(case, layout=layout)
    identifier = settings.identifier(plant, plant)
    no_state = xp.zeros(plant.modal_model.state_count)

    def update(sums, sample):
        readings, command, t = sample
        return identifier.update(sums, Measurement(readings, no_state, command), t)[1], None

    # A sample of a record holds the command that begins there; the law received the previous one.
    previous_commands = xp.concatenate([xp.zeros_like(record.command[:1]), record.command[:-1]])
    samples = record.measured, previous_commands, record.times
    sums, _ = scan(update, identifier.initial_state(), samples)
    estimate = identifier.estimate(sums, record.times[-1])
    return estimate.mass, estimate.speed
