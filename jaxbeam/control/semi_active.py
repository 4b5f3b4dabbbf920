"""Semi-active dampers: the forces of a law, clipped to those of a damper of variable rate.

A damper between beam and ground whose rate c is set between two limits gives the force

    u = -c v,     c = clip(-u_d / v, c_min, c_max),

with v the velocity of the beam there (m/s) and u_d the force that another law desires (N), as an
optimal one ("clipped optimal" control) or one against a velocity elsewhere ("skyhook"). As u is
u_d within -c_min v and -c_max v, it is continuous. "on-off" has the two rates alone, c_max where
the desired force opposes the velocity. Such a damper only takes energy.
"""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import (
    AbstractContinuousLaw,
    AbstractController,
    AbstractSampledLaw,
    ControlStep,
    commanded,
)
from jaxbeam.case.fields import NOT_NEGATIVE, choice, concrete, count, is_concrete, number, part
from jaxbeam.runtime.arrays import Array, Number, xp

NEAR = 1e-6  # of the length, distance of a sensor from its actuator
SHARED = "period", "delay", "dropout", "jitter", "resolution", "nominal_plant"  # of both laws


class SemiActive(AbstractController):
    """Law of semi-active dampers: the force of a `desired` law, by rates within their limits.

    Each actuator that takes commands is a damper between beam and ground, but for the last ones, as
    many as `active`: these exert the desired forces as they are, beside the dampers. The first
    sensors of velocity, in their order, are at the dampers. `desired` is any other controller of
    the same case, of all its actuators, without period and delay of its own. Under "on-off"
    commands jump, so that derivatives leave out what changes of the times of jumps change. In
    continuous time the force follows the velocity at once; with a `period` it is held, so that it
    may put in a little energy.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(25.0, 30e9, 15e3, damping_ratio=0.01, modes=3),
    ...     actuators=[jb.PointForce(12.5)],
    ...     sensors=[jb.Sensor(12.5, "velocity")],
    ...     loads=[jb.Axles(train="HSLM-A1", speed=62.5)],
    ...     controller=jb.SemiActive(
    ...         min_damping=2e3, max_damping=1e5, desired=jb.Feedback([5e4])
    ...     ),
    ...     run=jb.Run(7.0, sample_rate=200.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.1f} mm")
    12.6 mm
    """

    kind: ClassVar[str] = "semi-active"

    min_damping: Float[Number, " *actuator"] = number(
        "N s/m", "smallest rate of each damper", NOT_NEGATIVE
    )
    max_damping: Float[Number, " *actuator"] = number(
        "N s/m", "largest rate of each damper", NOT_NEGATIVE
    )
    desired: AbstractController | None = part("law of the desired forces", AbstractController)
    rates: str = choice(
        "rates between the limits, or the limits alone", "clipped", "on-off", default="clipped"
    )
    active: int = count("number of last actuators that are no dampers", minimum=0, default=0)

    @property
    def design_depends_on_loads(self) -> bool:
        return self.desired.design_depends_on_loads

    @property
    def design_depends_on_paths(self) -> bool:
        return self.desired.design_depends_on_paths

    def validate(self, case):
        if self.desired is None:
            return "desired is missing: give the law of the forces that the dampers should exert"
        dampers, inner = len(case.driven) - self.active, type(self.desired)
        if dampers < 1:
            return f"active must leave a damper of the {len(case.driven)} actuators"
        if inner.open_loop or inner is SemiActive:
            return "desired must be a law of readings, neither prescribed nor semi-active itself"
        given = [name for name in SHARED if getattr(self.desired, name) is not None]
        if given:
            return f"desired.{given[0]} is that of the damper: give it there"
        for name in ("min_damping", "max_damping"):
            shape = getattr(self, name).shape
            if shape not in ((), (dampers,)):
                return f"{name} must be one number or {dampers}, one a damper, not {shape[0]}"
        pair = self.min_damping, self.max_damping
        if all(map(is_concrete, pair)) and np.any(concrete(pair[0]) > concrete(pair[1])):
            return "max_damping must be at least min_damping"
        sensors = velocity_sensors(case)
        for k, i in enumerate(commanded(case.actuators)[:dampers]):
            terms = case.actuators[i].displacement_map()
            if len(terms) != 1 or terms[0][1] != 0:
                return f"kind needs actuators at points of the beam; actuators.{i} bends it"
            place = terms[0][0]
            if k >= len(sensors):
                return f"kind needs a sensor of velocity at each damper, one for actuators.{i} too"
            own = case.sensors[sensors[k]].position
            if all(map(is_concrete, (own, place, case.beam.length))) and (
                abs(concrete(own - place)) > NEAR * concrete(case.beam.length)
            ):
                return (
                    f"kind needs sensors of velocity at the dampers, in their order:"
                    f" sensors.{sensors[k]} is at {float(concrete(own)):g} m,"
                    f" actuators.{i} at {float(concrete(place)):g} m"
                )
        error = self._inner().validate(case)
        return error and f"desired.{error}"

    def breakpoints(self, case):
        return self._inner().breakpoints(case)

    def design_law(self, plant):
        dampers = len(plant.case.driven) - self.active
        low, high = (xp.broadcast_to(one, dampers) for one in (self.min_damping, self.max_damping))
        sensors = velocity_sensors(plant.case)[:dampers]
        desired = self._inner().design_law(plant)  # of the actuators that take commands, as here
        return SemiActiveLaw(desired, low, high, sensors, self.rates == "on-off")

    def _inner(self) -> AbstractController:
        """The desired law with the period and the delay of this one."""
        return dataclasses.replace(self.desired, period=self.period, delay=self.delay)


def velocity_sensors(case) -> tuple[int, ...]:
    """Indices of the sensors of velocity."""
    return tuple(i for i, one in enumerate(case.sensors) if one.quantity == "velocity")


class SemiActiveLaw(AbstractSampledLaw, AbstractContinuousLaw):
    """Desired law, rates (N s/m) between which its force is kept, and sensors of the velocities."""

    desired: Any
    min_damping: Float[Array, " damper"]
    max_damping: Float[Array, " damper"]
    sensors: tuple[int, ...] = eqx.field(static=True)
    on_off: bool = eqx.field(static=True)

    @property
    def filters(self):
        return self.desired.filters

    @property
    def state_count(self):
        return self.desired.state_count

    def initial_state(self):
        return self.desired.initial_state()

    def tabulated(self, times):
        return dataclasses.replace(self, desired=self.desired.tabulated(times))

    def step(self, state, measurement, t):
        command, state, solved = self.desired.step(state, measurement, t)
        return ControlStep(self._given(command, measurement), state, solved)

    def command(self, state, measurement, t):
        return self._given(self.desired.command(state, measurement, t), measurement)

    def rates(self, state, measurement, command, t):
        return self.desired.rates(state, measurement, command, t)

    def _given(self, desired, measurement):
        """Commands for desired ones: those of the dampers by rates within their limits."""
        desired, others = xp.split(desired, [len(self.sensors)])
        velocity = measurement.readings[np.array(self.sensors)]
        most, least = -self.max_damping * velocity, -self.min_damping * velocity
        if self.on_off:
            forces = xp.where(desired * velocity < 0, most, least)
        else:
            forces = xp.clip(desired, xp.minimum(most, least), xp.maximum(most, least))
        return xp.concatenate([forces, others])
