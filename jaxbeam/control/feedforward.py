"""Commands that follow from time or from the position of the load alone.

Where the voltage limits the control, commands that a light load allows at each position suit a
heavy load too: the schedule needs the position of the load, not its mass.

A table drawn by hand, from statics alone, is the baseline with which other laws are compared.
"""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.actuators.base import limited_loops
from jaxbeam.case.case import Case
from jaxbeam.case.controller import (
    AbstractController,
    AbstractSampledLaw,
    AbstractStaticController,
    ControlStep,
    commanded,
)
from jaxbeam.case.fields import (
    INCREASING,
    NOT_NEGATIVE,
    POSITIVE,
    concrete,
    deciding,
    is_concrete,
    number,
)
from jaxbeam.case.trajectory import NEVER, SAME_FRACTION, SAME_SAMPLE, SAME_TIME, has_come
from jaxbeam.model.deflection_lines import influence_line, static_deflection_per_command
from jaxbeam.runtime.arrays import Array, Number, xp


def without_control(case: Case) -> Case:
    """The case without its controller.

    It has commands of zero where a shaker's voltage has limits within an inner loop, which has no
    run without a controller (see `jaxbeam.case.validation.check_case`).
    """
    none = Prescribed(offsets=np.zeros(len(case.driven))) if limited_loops(case.actuators) else None
    return dataclasses.replace(case, controller=none)


class Prescribed(AbstractStaticController):
    """Commands as given functions of time.

    Each actuator receives its offset + sum of amplitudes sin(2 pi frequency t + phase), plus a
    table of values, interpolated linearly between its times and zero outside them (to hold a
    value, end the table after the run). Parts may be left out.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.Prescribed(
    ...         offsets=[2.0], amplitudes=[[0.5]], frequencies=[5.0], period=0.005
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.131 mm
    """

    without_reading: ClassVar[str] = "No reading is used."

    kind: ClassVar[str] = "prescribed"
    open_loop: ClassVar[bool] = True

    offsets: Float[Number, " actuator"] = number(
        "unit of a command", "constant command of each actuator"
    )
    amplitudes: Float[Number, "actuator sine"] | None = number(
        "unit of a command", "amplitudes of the sines, a row for each actuator", default=None
    )
    frequencies: Float[Number, " sine"] | None = number(
        "Hz", "frequencies of the sines", NOT_NEGATIVE, default=None
    )
    phases: Float[Number, "actuator sine"] | None = number(
        "rad", "phases of the sines at t = 0", default=None
    )
    times: Float[Number, " point"] | None = number(
        "s", "times of the table", INCREASING, default=None
    )
    values: Float[Number, "actuator point"] | None = number(
        "unit of a command", "commands of the table, a row for each actuator", default=None
    )

    def validate(self, case):
        count = len(case.driven)
        for name in ("offsets", "amplitudes", "phases", "values"):
            value = getattr(self, name)
            if value is not None and value.shape[0] != count:
                return (
                    f"{name} must have an entry for each of {count} actuators that take commands,"
                    f" not {value.shape[0]}"
                )
        if (self.amplitudes is None) != (self.frequencies is None):
            return "amplitudes and frequencies belong together; give both or neither"
        if self.phases is not None and self.amplitudes is None:
            return "phases have no effect without amplitudes and frequencies"
        for name in ("amplitudes", "phases"):
            value = getattr(self, name)
            if value is not None and value.shape[1] != self.frequencies.shape[0]:
                return f"{name} must have a column for each of the frequencies"
        if (self.times is None) != (self.values is None):
            return "times and values belong together; give both or neither"
        if self.times is not None and self.values.shape[1] != self.times.shape[0]:
            return "values must have a column for each of the times"
        return None

    def command(self, state, measurement, t):
        command = self.offsets
        if self.amplitudes is not None:
            angle = 2 * xp.pi * self.frequencies * t
            angle = angle if self.phases is None else angle + self.phases
            command = command + xp.sum(self.amplitudes * xp.sin(angle), axis=-1)
        if self.times is not None:
            # A sample at an end of the table is at it in single precision, too.
            rounding = SAME_TIME if self.period is None else SAME_SAMPLE
            command = command + _tabulated(self.times, self.values, t, rounding * t)
        return command

    def breakpoints(self, case):
        return self.times


CONFIRMATION_FRACTION = 0.25  # of the crossing, within which a sensor must detect the load


class Feedforward(AbstractController):
    """Commands tabulated over the relative position of a load, extrapolated from two gate times.

    The commands at the `shares` (fractions) of the crossing, 0 at the end where the load enters and
    1 at the other, are interpolated linearly and zero outside; those of several loads are added.
    Gates may lie before the beam (at a negative position if loads enter at the left). A load is
    assumed to keep the speed that it has between them; commands begin when it has passed the second
    gate. The table is read `lead` seconds ahead of the load, to compensate delay and hold. No
    sensor of the beam and no mass is used, so that no loop is closed that could become unstable.

    Gates that fire without a load would lift the beam. With a `confirmation` (m) commands begin
    when a deflection sensor has gone down by that much after the second gate, and within the first
    quarter of the crossing; if none has, there are none for that passage. Commands that have begun
    depend on time alone, as without it.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.Feedforward(
    ...         [-0.1, -0.05], [0.0, 0.5, 1.0], [[0.0, 3.0, 0.0]], period=0.005
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.798 mm
    """

    kind: ClassVar[str] = "feedforward"
    open_loop: ClassVar[bool] = True

    gates: Float[Number, "2"] = number("m", "positions of the gates, in the order of passage")
    shares: Float[Number, " breakpoint"] = number("1", "fractions of the crossing", INCREASING)
    values: Float[Number, "actuator breakpoint"] = number(
        "unit of a command", "commands of the table, a row for each actuator"
    )
    lead: Float[Number, ""] = number(
        "s", "time by which the table is read ahead of the load", NOT_NEGATIVE, default=0.0
    )
    confirmation: Float[Number, ""] | None = number(
        "m", "downward reading of a deflection sensor that shows a load", POSITIVE, default=None
    )
    gate_errors: Float[Number, "2"] = number(
        "m", "distance by which each gate is farther along than the law has it", default=(0.0, 0.0)
    )

    @property
    def design_depends_on_loads(self) -> bool:
        return False

    @property
    def design_depends_on_paths(self) -> bool:
        return True

    def validate(self, case):
        if self.period is None:
            return "period must be given: kind 'feedforward' acts at samples"
        if not case.loads:
            return "kind needs loads that pass the gates; add one, or take kind 'prescribed'"
        if self.values.shape != (len(case.driven), self.shares.shape[0]):
            return (
                f"values must have for each of {len(case.driven)} actuators as many entries as"
                f" shares has, {self.shares.shape[0]}; they are of shape {self.values.shape}"
            )
        if self.confirmation is not None and not _deflection_sensors(case.sensors):
            return "confirmation needs a sensor of the deflection: add one, or leave it out"
        if not all(is_concrete(leaf) for leaf in jax.tree.leaves((self, case))):
            return None
        true_gates = self.gates + self.gate_errors
        if np.any(~(np.diff(_gate_times(true_gates, case.loads, case.beam.length)) > 0)):
            return "gates must be two positions that every load passes, the first before the other"
        return None

    def design_law(self, plant):
        gate_times = xp.stack(
            [
                path.passage_times(self.gates + self.gate_errors)[:2]
                for path in plant.loads.trajectories
            ]
        )
        settings = self.gates, self.shares, self.values, self.lead
        length = plant.case.beam.length
        if self.confirmation is None:
            return FeedforwardLaw(*settings, gate_times, length)
        sensors = _deflection_sensors(plant.case.sensors)
        confirmation = deciding(self.confirmation, "controller.confirmation")
        return ConfirmedFeedforwardLaw(*settings, gate_times, length, confirmation, sensors)


class FeedforwardLaw(AbstractSampledLaw):
    """Table of commands and the times (s) at which each load passes the two gates."""

    without_reading: ClassVar[str] = "No reading is used."

    gates: Float[Array, "2"]
    shares: Float[Array, " breakpoint"]
    values: Float[Array, "actuator breakpoint"]
    lead: Float[Array, ""]
    gate_times: Float[Array, "load 2"]
    length: Float[Array, ""]

    def step(self, state, measurement, t):
        passed = has_come(self.gate_times[:, 1], t)
        return ControlStep(xp.sum(xp.where(passed, self.table_commands(t), 0.0), axis=1), state)

    def distances(self, t) -> Float[Array, " load"]:
        """Distance (m) of each load from the end where it enters at t (s), by its two gates."""
        speeds = xp.diff(self.gates) / xp.diff(self.gate_times, axis=1)[:, 0]
        gate_distance = xp.where(speeds < 0, self.length - self.gates[1], self.gates[1])
        return gate_distance + (t - self.gate_times[:, 1]) * xp.abs(speeds)

    def table_commands(self, t) -> Float[Array, "actuator load"]:
        """Commands of the table for each load at t (s), read ahead by the lead."""
        fractions = self.distances(t + self.lead) / self.length
        return _tabulated(self.shares, self.values, fractions, SAME_FRACTION)


class ConfirmedFeedforwardLaw(FeedforwardLaw):
    """Feedforward law whose commands begin only for loads that a deflection sensor has detected.

    Its state says for each load whether a sensor has read less than -`confirmation` (m) since the
    second gate, within the first CONFIRMATION_FRACTION of the crossing; a missing reading detects
    nothing.
    """

    without_reading: ClassVar[str] = "It shows no load."

    confirmation: Float[Array, ""]
    sensors: tuple[int, ...] = eqx.field(static=True)

    def initial_state(self):
        return xp.zeros(self.gate_times.shape[0], bool)

    def step(self, state, measurement, t):
        own = np.array(self.sensors)
        readings = measurement.readings[own]
        if measurement.present is not None:
            readings = xp.where(measurement.present[own], readings, 0.0)
        lowest = xp.min(readings)
        passed = has_come(self.gate_times[:, 1], t)
        early = self.distances(t) <= (CONFIRMATION_FRACTION + SAME_FRACTION) * self.length
        confirmed = state | (passed & early & (lowest <= -self.confirmation))
        commands = xp.where(confirmed, self.table_commands(t), 0.0)
        return ControlStep(xp.sum(commands, axis=1), confirmed)


def _deflection_sensors(sensors) -> tuple[int, ...]:
    """Indices of the sensors of deflection."""
    return tuple(i for i, sensor in enumerate(sensors) if sensor.quantity == "deflection")


def _tabulated(breakpoints, rows, x, rounding) -> Float[Array, "row ..."]:
    """Rows of a table interpolated at x, zero where x is beyond the ends by more than rounding."""
    inside = (x >= breakpoints[0] - rounding) & (x <= breakpoints[-1] + rounding)
    values = xp.stack([xp.interp(x, breakpoints, row) for row in rows])
    return xp.where(inside, values, 0.0)


def _gate_times(gates, loads, length) -> Float[np.ndarray, "load 2"]:
    """Times (s) at which each load passes the gates; NaN where it does not."""
    times = np.stack([concrete(load.trajectory(length).passage_times(gates))[:2] for load in loads])
    return np.where(times < NEVER, times, np.nan)


POINTS = 21  # of the table, over the crossing
RAMP_UP, RAMP_DOWN = 0.2, 0.1  # fractions of the crossing, at entry and exit
MIN_LIFT = 0.1  # of the largest lift of an actuator, below which it does not act
GATE_POSITIONS = -0.25, -0.08  # gates before the beam, in lengths of it, where none are given


def hand_drawn_law(
    case: Case, period: float = 0.01, delay: float = 0.0, gates: tuple[float, float] | None = None
) -> Feedforward:
    """Feedforward tabulated over the position of the load, from statics and limits alone.

    Each actuator lifts the beam at the load by its part of the static deflection under the heaviest
    load of the case, within its limits; the table of a weak actuator is a trapezium. It has ramps
    over the first fifth and the last tenth of the crossing, and is read ahead by the delay and half
    a period. `gates` (m) are by default a quarter and a twelfth of the length before the beam.

    Raises ValueError for a case without loads or without actuators that take commands, and as
    `influence_line` does.
    """
    active = commanded(case.actuators)
    if not case.loads or not active:
        raise ValueError("a law by hand needs a load and an actuator that takes commands")
    length = float(concrete(case.beam.length))
    fractions = np.linspace(0.0, 1.0, POINTS)
    leftwards = np.asarray(concrete(case.loads[0].trajectory(case.beam.length).direction())) < 0
    places = length * (1.0 - fractions if leftwards else fractions)
    lift = np.asarray(static_deflection_per_command(case, places))
    deflection = np.diagonal(np.asarray(influence_line(case, places, places)))
    gravity = case.run.gravity
    weights = [np.sum(concrete(load.vehicle(gravity).static_loads)) for load in case.loads]
    ramp = np.minimum(1.0, np.minimum(fractions / RAMP_UP, (1.0 - fractions) / RAMP_DOWN))
    rows = []
    for i in active:
        able = np.abs(lift[i]) > MIN_LIFT * np.abs(lift[i]).max()
        command = -max(weights) * deflection / np.where(able, lift[i], np.inf) / len(active)
        limits = case.actuators[i].command_limits()
        rows.append(ramp * (command if limits is None else np.clip(command, *concrete(limits))))
    if gates is None:
        first, second = (length * (1 - x if leftwards else x) for x in GATE_POSITIONS)
        gates = first, second
    return Feedforward(
        gates=list(gates),
        shares=fractions,
        values=np.array(rows),
        lead=delay + period / 2,
        period=period,
        delay=delay,
    )
