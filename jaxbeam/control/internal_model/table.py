"""Internal-model control of the deflection under a load, with the static lift as the model.

    u = f(y - c H u)

(Garcia and Morari, Industrial & Engineering Chemistry Process Design and Development 21, 1982). A
feedback gain high enough to use the whole voltage would make the loop through filters and delays
unstable. Here the deflection due to the commands, H u, is subtracted from the readings y: the rest
is the deflection due to the load, and feeding that back closes no loop if H is exact.
"""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.controller import AbstractController, AbstractSampledLaw, ControlStep
from jaxbeam.case.fields import INCREASING, POSITIVE, concrete, is_concrete, number
from jaxbeam.case.filters import filter_step, second_order_sections, steady_filter_state
from jaxbeam.runtime.arrays import Array, xp


class InternalModel(AbstractController):
    """Feedback of the deflection due to the load at each actuator's own sensor, u = f(y - c H u).

    The first actuator is fed by the first sensor, the second by the second, and so on. H u is the
    static deflection due to the present commands, behind the filters of the sensors, and c the
    `compensation`. f is a table: the `values` at the `readings` are interpolated linearly, and held
    beyond the ends. Where the table is flat the loop is open, so a load that deflects the beam
    beyond its last reading opens the loop. Mass, speed and position of the load are not used.

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

    readings: Float[Array, " breakpoint"] = number("m", "deflections due to the load", INCREASING)
    values: Float[Array, "actuator breakpoint"] = number(
        "unit of a command", "commands of the table, a row for each actuator"
    )
    compensation: Float[Array, ""] = number(
        "1", "share of the lift of the commands that is subtracted from the readings", default=1.0
    )
    notches: Float[Array, " notch"] | None = number(
        "Hz", "frequencies of the notches", POSITIVE, default=None
    )
    notch_damping: Float[Array, ""] = number(
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
