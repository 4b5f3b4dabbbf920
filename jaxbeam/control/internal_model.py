"""Commands that answer what the load makes the beam sink, from readings of deflection alone.

A gain high enough to use all the voltage there is would make the loop through filters and delays
unstable. So what the commands themselves do to the readings is taken off them first: what remains
is the deflection under the load, and answering that, however steeply, closes no loop, as long as
the lift of the actuators is known (internal model control: Garcia and Morari, Industrial &
Engineering Chemistry Process Design and Development 21, 1982, with the static model).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import INCREASING, POSITIVE, concrete, is_concrete, number
from jaxbeam.case.filters import filter_step, second_order_sections, steady_filter_state
from jaxbeam.model.state_space import Plant


class InternalModelState(eqx.Module):
    """Memory of `Relief`: lift (m per unit of a command), filters, and what has passed them.

    The filters of each sensor are those of its own, for the lift, and the notches.
    """

    static_lift: Float[Array, "actuator actuator"]
    sensor_filters: tuple[Float[Array, "_ 6"] | None, ...]
    notch_sections: Float[Array, "notch 6"] | None
    sensor_filter_states: tuple[Float[Array, "_ 2"] | None, ...]
    notch_states: Float[Array, "notch 2 actuator"] | None


class Relief(AbstractController):
    """u = f(y - c H u): each actuator answers the deflection under the load at its own sensor.

    The first actuator listens to the first sensor, the second to the second, and so on. H u is the
    static deflection that the commands in force would cause, seen through the filters of the
    sensors, and c the `compensation`. f is a table: the `values` at the `readings` are joined by
    straight lines, and those at its ends hold beyond. Where a table is flat no deviation is
    answered, so a load that sinks the beam beyond its last reading leaves the loop open there.
    Neither mass nor speed nor place of the load is used.

    What the static lift does not know is how the beam rings. Where the sensors' filters let that
    through, `notches` take it out of y - c H u: (s^2 + w^2) / (s^2 + 2 zeta w s + w^2) each, which
    delays slow changes by 2 zeta / w only.
    """

    readings: Float[Array, " knot"] = number("m", "deflections under the load", INCREASING)
    values: Float[Array, "actuator knot"] = number(
        "unit of a command", "a list of commands for each actuator"
    )
    compensation: Float[Array, ""] = number(
        "1", "share of the commands' own lift that is taken off the readings", default=1.0
    )

    notches: Float[Array, " notch"] | None = number(
        "Hz", "frequencies that are taken out", POSITIVE, default=None
    )
    notch_damping: Float[Array, ""] = number(
        "1", "damping ratio of the notches: half their relative width", POSITIVE, default=0.5
    )

    @property
    def design_depends_on_loads(self) -> bool:
        return False

    def validate(self, case):
        actuators = len(case.actuators)
        if self.period is None:
            return "period must be given: kind 'relief' acts at its ticks"
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

    def init(self, plant: Plant):
        system, sensors = plant.unloaded, plant.case.sensors[: self.values.shape[0]]
        static_response = jnp.linalg.solve(system.A.T, system.C[: len(sensors)].T).T
        filters = tuple(
            None if sensor.filter is None else second_order_sections(sensor.filter, self.period)
            for sensor in sensors
        )
        filter_states = tuple(
            None if part is None else steady_filter_state(part, 0.0) for part in filters
        )
        notches = None if self.notches is None else self._notch_sections()
        notch_states = (
            None if notches is None else steady_filter_state(notches, jnp.zeros(len(sensors)))
        )
        return InternalModelState(
            -static_response @ system.B, filters, notches, filter_states, notch_states
        )

    def _notch_sections(self) -> Float[Array, "notch 6"]:
        """The notches, sampled: bilinear transforms that are warped to meet their frequencies."""
        warped = jnp.tan(jnp.pi * self.notches * self.period)
        wide, one = 2 * self.notch_damping * warped, jnp.ones_like(warped)
        whole = 1 + wide + warped**2
        middle, side = 2 * (warped**2 - 1) / whole, (1 + warped**2) / whole
        last = (1 - wide + warped**2) / whole
        return jnp.stack([side, middle, side, one, middle, last], axis=1)

    def step(self, memory, measurement, t):
        commanded_deflection = memory.lift @ measurement.command
        filtered, filter_states = [], []
        for value, filters, before in zip(
            commanded_deflection, memory.filters, memory.passed, strict=True
        ):
            value, after = (value, None) if filters is None else filter_step(filters, before, value)
            filtered.append(value)
            filter_states.append(after)
        readings = measurement.readings[: commanded_deflection.shape[0]]
        load_deflection, notch_states = (
            readings - self.compensation * jnp.stack(filtered),
            memory.notch_states,
        )
        if memory.notches is not None:
            load_deflection, notch_states = filter_step(
                memory.notches, notch_states, load_deflection
            )
        command = jax.vmap(lambda x, row: jnp.interp(x, self.readings, row))(
            load_deflection, self.values
        )
        return command, eqx.tree_at(
            lambda m: (m.passed, m.notch_states),
            memory,
            (tuple(filter_states), notch_states),
            is_leaf=lambda x: x is None,
        )
