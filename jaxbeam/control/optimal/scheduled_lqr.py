"""Finite-horizon gains scheduled over mass and speed of the load, given or identified."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import ControlStep
from jaxbeam.case.fields import INCREASING, choice, concrete, is_concrete, number, part
from jaxbeam.control.load_identification import LoadIdentification, identification_error
from jaxbeam.control.load_identifiers import AbstractLoadSource, given_load
from jaxbeam.control.optimal.crossing_lqr import AbstractFiniteHorizonRegulator, interval_error
from jaxbeam.control.optimal.gain_schedules import GainSchedule
from jaxbeam.control.state_law import AbstractStateLaw
from jaxbeam.model.load_set import load_set
from jaxbeam.model.state_space import Plant
from jaxbeam.runtime.arrays import Array


class ScheduledLQR(AbstractFiniteHorizonRegulator):
    """Optimal gains k(m) or k(m, v) over the crossing, section 5.3 of the thesis.

    A `FiniteLQR` is designed for each of the `masses` and `speeds` (magnitudes; that of the load in
    the design if left out), at constant speed. Between them commands are "interpolated" linearly,
    or those of the "nearest" design are used; outside, the mass or speed is clamped to the grid.
    The tables are stretched to the speed of the load, also outside the grid. With loads "known" the
    weight of that mass is fed forward, as in `AugmentedLQR`. States of a vehicle are fed back; one
    of another mass is similar to that of the design: all its masses, springs and dampers are in
    proportion, so that its frequencies stay.

    Mass, speed and entry time are those of the load in the design, or identified by
    `load_identification`: then the command is zero until the speed is identified, and the lightest
    mass is assumed until the mass is.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.ScheduledLQR(
    ...         state_weight=[1e7, 10.0],
    ...         command_weight=[1e-3],
    ...         period=0.005,
    ...         masses=[0.2, 0.5],
    ...         loads="known",
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> jb.save_case(case, "regulator.toml")
    >>> print(jb.load_case("regulator.toml").controller.masses)
    [0.2 0.5]
    """

    kind: ClassVar[str] = "lqr-scheduled"

    masses: Float[Array, " mass"] = number("kg", "masses of the designs", INCREASING, kw_only=True)
    speeds: Float[Array, " speed"] | None = number(
        "m/s", "speeds of the designs", INCREASING, default=None
    )
    between: str = choice(
        "commands between designs", "interpolated", "nearest", default="interpolated"
    )
    loads: str = choice("weights of the loads", "ignored", "known", default="ignored")
    load_identification: LoadIdentification | None = part(
        "how mass and speed are identified", LoadIdentification
    )

    @property
    def load_feedforward(self) -> bool:
        return self.loads == "known"

    def design_state_law(self, plant, design_plant):
        load = design_plant.case.loads[0]
        speeds = jnp.abs(load.speed)[None] if self.speeds is None else self.speeds

        def design(mass, speed):
            return self.gain_schedule(plant, with_crossing_load(design_plant, mass, speed))

        schedules = jax.vmap(jax.vmap(design, (None, 0)), (0, None))(
            jnp.asarray(self.masses), jnp.asarray(speeds)
        )
        source = given_load(load, design_plant.case.run.gravity)
        if self.load_identification is not None:
            source = self.load_identification.identifier(plant, design_plant)
        return ScheduledGainLaw(
            schedules,
            self.masses,
            speeds,
            plant.case.beam.length,
            jnp.abs(load.speed),
            source,
            self.between == "nearest",
            design_plant.weights.shape[0],
        )

    def validate(self, case):
        gravity = case.run.gravity
        if len(case.loads) != 1 or any(
            load.speed is None or load.total_mass(gravity) is None for load in case.loads
        ):
            return "kind needs a single load, with a mass and a speed; or take another kind"
        if self.entries == "predicted":
            return "entries must be 'measured': the table follows the load, given or identified"
        for name in ("masses", "speeds"):
            values = getattr(self, name)
            if values is not None and (values.size == 0 or _any_not_positive(values)):
                return f"{name} must list at least one, and positive ones"
        error = identification_error(self, case)
        if error is None and self.speeds is not None:
            error = interval_error(self, case, self.speeds[0])
        return error or super().validate(case)


class ScheduledGainLaw(AbstractStateLaw):
    """Gain schedules (mass, speed) and the source of the load, whose state is that of the law.

    `design_speed` (m/s) is the speed of the load in the design. What is fed forward are weights in
    proportion to the mass and, with a profile, the constant 1.
    """

    schedules: GainSchedule
    masses: Float[Array, " mass"]
    speeds: Float[Array, " speed"]
    length: Float[Array, ""]
    design_speed: Float[Array, ""]
    load_source: AbstractLoadSource
    nearest: bool = eqx.field(static=True)
    weight_count: int = eqx.field(static=True)

    @property
    def needs_vehicles(self):
        return self.schedules.needs_vehicles

    def initial_state(self):
        return self.load_source.initial_state()

    def step(self, state, estimate, measurement, t):
        load, state = self.load_source.update(state, measurement, t)
        mass = jnp.where(load.mass_identified, load.mass, self.masses[0])
        speed, entry = jnp.abs(load.speed), load.entry_time
        end = entry + self.length / speed
        # In proportion to the mass between the designs, which differ in it alone.
        clamped_mass = jnp.clip(mass, self.masses[0], self.masses[-1])
        lightest = self.schedules.load_weights[0, 0]
        constant = jnp.arange(lightest.shape[0]) >= self.weight_count
        load_weights = jnp.where(constant, lightest, lightest * clamped_mass / self.masses[0])

        def command_of(schedule):
            stretched = dataclasses.replace(
                schedule, load_weights=load_weights, start=entry, end=end
            )
            return stretched.step((), estimate, measurement, t).command

        commands = jax.vmap(jax.vmap(command_of))(self.schedules)
        shares = self._interpolation(self.masses, mass), self._interpolation(self.speeds, speed)
        command = jnp.einsum("m,v,mva->a", *shares, commands)
        return ControlStep(jnp.where(load.speed_identified, command, 0.0), state)

    def _interpolation(self, grid, value) -> Float[Array, " design"]:
        """Weight of each design of a grid at a value."""
        if self.nearest:
            return jax.nn.one_hot(jnp.argmin(jnp.abs(grid - value)), grid.shape[0], dtype=float)
        unit_vectors = jnp.eye(grid.shape[0])
        return jax.vmap(lambda weights: jnp.interp(value, grid, weights))(unit_vectors)


def _any_not_positive(values) -> bool:
    return is_concrete(values) and bool(np.any(concrete(values) <= 0))


def with_crossing_load(plant: Plant, mass, speed) -> Plant:
    """Plant with another mass (kg) at another constant speed (m/s), in the same direction.

    A vehicle of another mass is a similar one, of the same frequencies.
    """
    load, gravity = plant.case.loads[0], plant.case.run.gravity
    changed = eqx.tree_at(
        lambda x: (x.speed, x.deceleration), load, (jnp.sign(load.speed) * speed, jnp.zeros(()))
    )
    case = eqx.tree_at(lambda c: c.loads, plant.case, (changed,))
    loads = load_set(case, plant.modal_model.modes.layout)
    wheels = loads.wheels.scaled(mass / load.total_mass(gravity))
    return dataclasses.replace(plant, case=case, loads=dataclasses.replace(loads, wheels=wheels))
