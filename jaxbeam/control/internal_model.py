"""Internal-model control of the deflection under a load: with a table, and for any rig.

    u = f(y - c H u)

(Garcia and Morari, Industrial & Engineering Chemistry Process Design and Development 21, 1982). A
feedback gain high enough to use the whole voltage would make the loop through filters and delays
unstable. Here the deflection due to the commands, H u, is subtracted from the readings y: the rest
is the deflection due to the load, and feeding that back closes no loop if H is exact.

    u = g(s),   s_i = R (l_i - y_i / F_i) / L_i,   l = H u

with the static lift H u of the acting commands, the readings y behind the filters F of the sensors,
and the lift L_i of the full command of an actuator at its own sensor. The equaliser R / F brings
readings behind any filter to those behind a reference filter R: the loop is then the same on rigs
of any filters, and as lift and limits are the units of the table g, one table serves all of them.
"""

import math
from typing import ClassVar

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.controller import AbstractController, AbstractSampledLaw, ControlStep
from jaxbeam.case.fields import INCREASING, POSITIVE, concrete, count, is_concrete, number
from jaxbeam.case.sensors import Filter, filter_step, second_order_sections, steady_filter_state
from jaxbeam.runtime.arrays import Array, Module, Number, xp


class InternalModel(AbstractController):
    """Internal-model control at each actuator's own sensor: u = f(y - c H u).

    y - c H u is the deflection due to the load. The first actuator is fed by the first sensor, the
    second by the second, and so on. H u is the static deflection due to the present commands,
    behind the filters of the sensors, and c the `compensation`. f is a table: the `values` at the
    `readings` are interpolated linearly, and held beyond the ends. Where the table is flat the loop
    is open, so a load that deflects the beam beyond its last reading opens the loop. Mass, speed
    and position of the load are not used.

    The static lift lacks the vibration of the beam. Where the filters of the sensors pass it,
    `notches` remove it from y - c H u: each is (s^2 + w^2) / (s^2 + 2 zeta w s + w^2), which delays
    slow changes by 2 zeta / w.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.InternalModel([-2e-3, 0.0, 2e-3], [[3.0, 0.0, -3.0]], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.883 mm
    """

    kind: ClassVar[str] = "internal-model"

    readings: Float[Number, " breakpoint"] = number("m", "deflections due to the load", INCREASING)
    values: Float[Number, "actuator breakpoint"] = number(
        "unit of a command", "commands of the table, a row for each actuator"
    )
    compensation: Float[Number, ""] = number(
        "1",
        "fraction of the lift of the commands that is subtracted from the readings",
        default=1.0,
    )
    notches: Float[Number, " notch"] | None = number(
        "Hz", "frequencies of the notches", POSITIVE, default=None
    )
    notch_damping: Float[Number, ""] = number(
        "1", "damping ratio of the notches: half their relative width", POSITIVE, default=0.5
    )

    @property
    def design_depends_on_loads(self) -> bool:
        return False

    def validate(self, case):
        actuators = len(case.driven)
        if self.period is None:
            return "period must be given: kind 'internal-model' acts at samples"
        if self.values.shape != (actuators, self.readings.shape[0]):
            return (
                f"values must have for each of {actuators} actuators as many entries as readings"
                f" has, {self.readings.shape[0]}; they are of shape {self.values.shape}"
            )
        if self.notches is not None and is_concrete(self.notches) and is_concrete(self.period):
            nyquist = 0.5 / float(concrete(self.period))
            if concrete(self.notches).max(initial=0.0) >= nyquist:
                return (
                    f"notches must be below half the sampling frequency, {nyquist:g} Hz: lower"
                    " them, or sample faster"
                )
        paired_sensors = case.sensors[:actuators]
        if len(paired_sensors) < actuators or any(
            sensor.quantity != "deflection" for sensor in paired_sensors
        ):
            return (
                f"kind needs a sensor of deflection for each of {actuators} actuators, before all"
                " other sensors"
            )
        return None

    def design_law(self, plant):
        system, sensors = plant.unloaded, plant.case.sensors[: self.values.shape[0]]
        return InternalModelLaw(
            readings=self.readings,
            values=self.values,
            compensation=self.compensation,
            static_lift=system.static_response(slice(len(sensors))) @ system.B,
            sensor_filters=tuple(
                None if sensor.filter is None else second_order_sections(sensor.filter, self.period)
                for sensor in sensors
            ),
            notch_sections=None if self.notches is None else self._notch_sections(),
        )

    def _notch_sections(self) -> Float[Array, "notch 6"]:
        """Sampled notches: bilinear transforms, warped to be exact at their frequencies."""
        warped = xp.tan(xp.pi * self.notches * self.period)
        damping_term, ones = 2 * self.notch_damping * warped, xp.ones_like(warped)
        leading = 1 + damping_term + warped**2
        middle, outer = 2 * (warped**2 - 1) / leading, (1 + warped**2) / leading
        last = (1 - damping_term + warped**2) / leading
        return xp.stack([outer, middle, outer, ones, middle, last], axis=1)


class InternalModelLaw(AbstractSampledLaw):
    """Table f, static lift H (m per unit of a command), and filters as second-order sections.

    `sensor_filters` are those of each sensor, for H u; `notch_sections` act on all of y - c H u.
    The state holds those of the sensor filters and those of the notches.
    """

    readings: Float[Array, " breakpoint"]
    values: Float[Array, "actuator breakpoint"]
    compensation: Float[Array, ""]
    static_lift: Float[Array, "actuator actuator"]
    sensor_filters: tuple[Float[Array, "section 6"] | None, ...]
    notch_sections: Float[Array, "notch 6"] | None

    def initial_state(self):
        filter_states = tuple(
            None if sections is None else steady_filter_state(sections, 0.0)
            for sections in self.sensor_filters
        )
        if self.notch_sections is None:
            return filter_states, None
        at_rest = xp.zeros(len(self.sensor_filters))
        return filter_states, steady_filter_state(self.notch_sections, at_rest)

    def step(self, state, measurement, t):
        (previous_states, notch_states), filter_states, filtered_lift = state, [], []
        lift = self.static_lift @ measurement.command
        for value, sections, previous in zip(
            lift, self.sensor_filters, previous_states, strict=True
        ):
            value, filter_state = (
                (value, None) if sections is None else filter_step(sections, previous, value)
            )
            filtered_lift.append(value)
            filter_states.append(filter_state)
        load_deflection = measurement.readings[: lift.shape[0]] - self.compensation * xp.stack(
            filtered_lift
        )
        if self.notch_sections is not None:
            load_deflection, notch_states = filter_step(
                self.notch_sections, notch_states, load_deflection
            )
        pairs = zip(load_deflection, self.values, strict=True)
        command = xp.stack([xp.interp(x, self.readings, row) for x, row in pairs])
        return ControlStep(command, (tuple(filter_states), notch_states))


SHARES = (-0.6, -0.3, -0.15, 0.0, 0.15, 0.3, 0.6, 0.9, 1.2, 1.6, 2.2)
VALUES = (-0.97, -0.5, -0.17, 0.0, 0.28, 0.38, 0.6, 0.74, 0.84, 0.96, 1.0)
REFERENCE, ORDER = 0.4, 4
FAST = 0.4  # of the sampling frequency: cutoff of sections of the reference beyond its own order


class ScheduledInternalModel(AbstractController):
    """Internal-model control for rigs of any filters, delay, lift and limits, without tuning.

    The first actuator is fed by the first sensor, the second by the second, and so on. The
    deflection due to the load is the reading less the static lift of the acting commands, both
    behind a reference filter: Butterworth of the `order`, with a cutoff at `reference` times the
    lowest natural frequency. What a digital filter of a sensor has removed below that cutoff is
    restored, and the reading of a fast filter is slowed down to the same. Filters must be digital:
    noise that enters behind an analogue one would be amplified as well.

    Commands follow from a table. `shares` are deflections due to the load, downwards positive, over
    the lift of the full command of the actuator; `values` are the commands for them over the full
    one, negative ones over the opposite limit. They are interpolated linearly and held beyond the
    ends, where the loop is open. If left out they are those that
    `experiments.studies.one_law_search` found on two rigs, with several delays, rigidities and
    loads at once.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3, limits=[-1.0, 2.0])],
    ...     sensors=[jb.Sensor(0.3, filter=jb.Filter(5.0, order=10))],
    ...     loads=[jb.MovingMass(mass=0.4, speed=1.0)],
    ...     controller=jb.ScheduledInternalModel(period=0.01, delay=0.02),
    ...     run=jb.Run(0.65),
    ... )
    >>> bound = jb.bound(case)
    >>> print(f"{bound.share(jb.simulate(case)):.0%} of what is attainable")
    87% of what is attainable
    """

    kind: ClassVar[str] = "internal-model-scheduled"

    shares: Float[Number, " breakpoint"] = number(
        "1",
        "deflections due to the load over the lift of the full command",
        INCREASING,
        default=SHARES,
    )
    values: Float[Number, " breakpoint"] = number(
        "1", "commands over the full one, negative ones over the opposite limit", default=VALUES
    )
    reference: Float[Number, ""] = number(
        "1",
        "cutoff of the reference filter over the lowest natural frequency",
        POSITIVE,
        default=REFERENCE,
    )
    order: int = count("order of the reference filter", default=ORDER)

    @property
    def design_depends_on_loads(self) -> bool:
        return False

    def validate(self, case):
        actuators = case.driven
        if self.period is None:
            return "period must be given: kind 'internal-model-scheduled' acts at samples"
        if self.values.shape != self.shares.shape:
            return (
                f"values must have as many entries as shares, {self.shares.shape[0]}, not"
                f" {self.values.shape[0]}"
            )
        if self.order % 2:
            return f"order must be even, as its sections are of second order; it is {self.order}"
        sensors = case.sensors[: len(actuators)]
        if len(sensors) < len(actuators) or any(s.quantity != "deflection" for s in sensors):
            return (
                f"kind needs a sensor of deflection for each of {len(actuators)} actuators, before"
                " all other sensors"
            )
        for i, sensor in enumerate(sensors):
            if sensor.filter is not None and not sensor.has_digital_filter:
                return (
                    f"kind needs digital filters, which it equalises; sensors.{i}.filter is"
                    " analogue: noise behind it would be amplified"
                )
            if sensor.sampling_period is not None:
                return f"kind samples all sensors itself: leave out sensors.{i}.sampling_period"
        for i, actuator in enumerate(case.actuators):
            if actuator.command_unit != "1" and actuator.command_limits() is None:
                return f"kind needs limits, the unit of its table: give actuators.{i}.limits"
        return None

    def design_law(self, plant):
        system, case = plant.unloaded, plant.case
        sensors = case.sensors[: len(case.driven)]
        static_lift = system.static_response(slice(len(sensors))) @ system.B
        own_lift = xp.diag(static_lift)
        limits = xp.stack([actuator.command_limits() for actuator in case.driven])
        lifts = own_lift[:, None] * limits
        # The full command is the limit that lifts the most, whatever the sign of the lift.
        full = xp.where(lifts[:, 0] > lifts[:, 1], limits[:, 0], limits[:, 1])
        opposite = xp.sum(limits, axis=1) - full
        filters = tuple(
            None if s.filter is None else second_order_sections(s.filter, self.period)
            for s in sensors
        )
        orders = [0 if s.filter is None else s.filter.order for s in sensors]
        reference = self.reference_sections(plant.modal_model.modes.frequencies[0], max(orders))
        return ScheduledInternalModelLaw(
            self.shares,
            self.values,
            full,
            opposite,
            static_lift,
            own_lift * full,
            xp.stack([sensor.offset for sensor in sensors]),
            tuple(
                reference if sections is None else equaliser(sections, order, reference)
                for sections, order in zip(filters, orders, strict=True)
            ),
            reference,
            tuple(self._periods_late(sensor) for sensor in sensors),
        )

    def reference_sections(self, lowest_frequency, largest_order: int) -> Float[Array, "section 6"]:
        """Reference filter, with fast sections as far as filters of the sensors have more."""
        filter = Filter(self.reference * lowest_frequency, order=self.order)
        sections = second_order_sections(filter, self.period)
        lacking = math.ceil(largest_order / 2) - math.ceil(self.order / 2)
        if lacking <= 0:
            return sections
        fast = Filter(FAST / self.period, order=2 * lacking)
        return xp.concatenate([sections, second_order_sections(fast, self.period)])

    def _periods_late(self, sensor) -> int:
        """Number of periods by which the command seen in a reading is older than the acting one."""
        if sensor.delay is None:
            return 0
        needed = [sensor.delay, self.period] + ([] if self.delay is None else [self.delay])
        if not all(is_concrete(value) for value in needed):
            raise ValueError(
                "controller of kind 'internal-model-scheduled' needs concrete delays: leave period"
                " and delays out of what is traced"
            )
        late, period, *delay = (float(concrete(value)) for value in needed)
        before = (delay[0] if delay else 0.0) / period
        return math.floor(before + late / period + 1e-9) - math.floor(before + 1e-9)


def equaliser(
    sections: Float[Array, "section 6"], order: int, reference: Float[Array, "reference 6"]
) -> Float[Array, "reference 6"]:
    """Sections of the equaliser R / F from a Butterworth filter F of an `order` to a reference R.

    Both have their zeros at half the sampling frequency, where those of F cancel. The static gain
    of each section is one.
    """
    rows = list(reference)
    for i, (section, target) in enumerate(zip(sections, reference, strict=False)):
        first_order = order % 2 == 1 and i == 0
        a1, a2 = section[4], section[5]
        # (1 + 1/z)^2 over the zeros of F: one, or 1 + 1/z for its section of first order.
        numerator = [1.0, 1.0 + a1, a1] if first_order else [1.0, a1, a2]
        numerator = xp.stack([xp.asarray(x, float) for x in numerator])
        gain = (1 + target[4] + target[5]) / xp.sum(numerator)
        rows[i] = xp.concatenate([gain * numerator, target[3:]])
    return xp.stack(rows)


class LawState(Module):
    """States of the equalisers and of the reference filter, and the last acting commands."""

    equalisers: tuple[Float[Array, "section 2"], ...]
    reference: Float[Array, "section 2 sensor"]
    commands: Float[Array, "age actuator"]


class ScheduledInternalModelLaw(AbstractSampledLaw):
    """Table, full and opposite commands, static lift (m per unit of a command), and filters.

    `own_lift` (m) is that of the full commands at their own sensors; `late` the number of commands
    by which readings are older.
    """

    shares: Float[Array, " breakpoint"]
    values: Float[Array, " breakpoint"]
    full: Float[Array, " actuator"]
    opposite: Float[Array, " actuator"]
    static_lift: Float[Array, "sensor actuator"]
    own_lift: Float[Array, " actuator"]
    offsets: Float[Array, " sensor"]
    equalisers: tuple[Float[Array, "section 6"], ...]
    reference: Float[Array, "section 6"]
    late: tuple[int, ...] = eqx.field(static=True)

    def initial_state(self):
        sensors, actuators = self.static_lift.shape
        return LawState(
            tuple(steady_filter_state(sections, 0.0) for sections in self.equalisers),
            steady_filter_state(self.reference, xp.zeros(sensors)),
            xp.zeros((max(self.late) + 1, actuators)),
        )

    def step(self, state, measurement, t):
        commands = xp.concatenate([measurement.command[None], state.commands[:-1]])
        lift = xp.stack(
            [row @ commands[n] for row, n in zip(self.static_lift, self.late, strict=True)]
        )
        lift, reference_state = filter_step(self.reference, state.reference, lift)
        equalised, equaliser_states = [], []
        for i, sections in enumerate(self.equalisers):
            reading = measurement.readings[i] - self.offsets[i]
            reading, equaliser_state = filter_step(sections, state.equalisers[i], reading)
            equalised.append(reading)
            equaliser_states.append(equaliser_state)
        ratios = (lift - xp.stack(equalised)) / self.own_lift
        values = xp.interp(ratios, self.shares, self.values)
        command = xp.where(values > 0, values * self.full, -values * self.opposite)
        return ControlStep(command, LawState(tuple(equaliser_states), reference_state, commands))
