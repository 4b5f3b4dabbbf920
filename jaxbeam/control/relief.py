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

from jaxbeam.controller import AbstractController
from jaxbeam.fields import INCREASING, number
from jaxbeam.filters import filter_step, initial, sections
from jaxbeam.statespace import LoadedBeam


class Watch(eqx.Module):
    """Memory of `Relief`: lift (m per unit of a command), and the sensors' filters on it."""

    lift: Float[Array, "actuator actuator"]
    filters: tuple[Float[Array, "section 6"] | None, ...]
    passed: tuple[Float[Array, "section 2"] | None, ...]


class Relief(AbstractController):
    """u = f(y - c H u): each actuator answers the deflection under the load at its own sensor.

    The first actuator listens to the first sensor, the second to the second, and so on. H u is the
    static deflection that the commands in force would cause, seen through the filters of the
    sensors, and c the `compensation`. f is a table: the `values` at the `readings` are joined by
    straight lines, and those at its ends hold beyond. Where a table is flat no deviation is
    answered, so a load that sinks the beam beyond its last reading leaves the loop open there.
    Neither mass nor speed nor place of the load is used.
    """

    readings: Float[Array, " knot"] = number("m", "deflections under the load", INCREASING)
    values: Float[Array, "actuator knot"] = number(
        "unit of a command", "a list of commands for each actuator"
    )
    compensation: Float[Array, ""] = number(
        "1", "share of the commands' own lift that is taken off the readings", default=1.0
    )

    @property
    def knows_loads(self) -> bool:
        return False

    def fault(self, case):
        actuators = len(case.actuators)
        if self.period is None:
            return "period must be given: kind 'relief' acts at its ticks"
        if self.values.shape != (actuators, self.readings.shape[0]):
            return (
                f"values must have for each of {actuators} actuators as many entries as readings"
                f" has, {self.readings.shape[0]}; they are of shape {self.values.shape}"
            )
        own = case.sensors[:actuators]
        if len(own) < actuators or any(sensor.quantity != "deflection" for sensor in own):
            return (
                f"kind needs a sensor of deflection for each of {actuators} actuators, before all"
                " other sensors"
            )
        return None

    def init(self, model: LoadedBeam):
        plant, sensors = model.unloaded, model.case.sensors[: self.values.shape[0]]
        rows = jnp.linalg.solve(plant.A.T, plant.C[: len(sensors)].T).T
        filters = tuple(
            None if sensor.filter is None else sections(sensor.filter, self.period)
            for sensor in sensors
        )
        passed = tuple(None if part is None else initial(part, 0.0) for part in filters)
        return Watch(-rows @ plant.B, filters, passed)

    def step(self, memory, measurement, t):
        caused = memory.lift @ measurement.command
        seen, passed = [], []
        for value, filters, before in zip(caused, memory.filters, memory.passed, strict=True):
            value, after = (value, None) if filters is None else filter_step(filters, before, value)
            seen.append(value)
            passed.append(after)
        own = measurement.readings[: caused.shape[0]]
        offsets = own - self.compensation * jnp.stack(seen)
        command = jax.vmap(lambda x, row: jnp.interp(x, self.readings, row))(offsets, self.values)
        return command, eqx.tree_at(
            lambda m: m.passed, memory, tuple(passed), is_leaf=lambda x: x is None
        )
