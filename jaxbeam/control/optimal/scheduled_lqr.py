"""A family of gain tables over masses and speeds, for loads that are told or recognised."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.fields import INCREASING, choice, concrete, is_concrete, number, part
from jaxbeam.control.load_identification import Recognition
from jaxbeam.control.load_update import AbstractLoadIdentifier
from jaxbeam.control.optimal.gain_schedules import GainSchedule
from jaxbeam.control.optimal.lqr import FiniteLQR, points_error
from jaxbeam.model.contact import load_set
from jaxbeam.model.state_space import Plant


class GainScheduleGrid(eqx.Module):
    """Schedules for each mass and speed, and what is known of the load.

    `given` are its mass (kg), speed (m/s) and time of entry (s) if they are given beforehand;
    `gravity` (m/s^2) makes a weight of the mass.
    """

    schedules: GainSchedule
    masses: Float[Array, " mass"]
    speeds: Float[Array, " speed"]
    length: Float[Array, ""]
    given: Float[Array, "3"]
    gravity: Float[Array, ""]
    identifier: AbstractLoadIdentifier | None


class ScheduledLQR(FiniteLQR):
    """Optimal gains k(m) or k(m, v) over the crossing, section 5.3 of the thesis.

    `FiniteLQR` is designed for each of the `masses` and `speeds` (magnitudes; that of the load, as
    believed, if left out), at constant speed. Between them commands are "interpolated" linearly, or
    those of the "nearest" design are given; outside, the mass or speed is clamped to the grid. The
    tables are stretched to the speed of the load, also outside the grid. With loads "known" the
    weight of that mass is fed forward, as in `AugmentedLQR`.

    Mass, speed and time of entry are those of the load as believed, or found by the `recognition`:
    then there is no command before the speed is told, and the lightest mass is assumed until the
    mass is told.
    """

    masses: Float[Array, " mass"] = number(
        "kg", "masses that are designed for", INCREASING, kw_only=True
    )
    speeds: Float[Array, " speed"] | None = number(
        "m/s", "speeds that are designed for", INCREASING, default=None
    )
    between: str = choice("between designs", "interpolated", "nearest", default="interpolated")
    loads: str = choice("weights of the loads", "ignored", "known", default="ignored")
    recognition: Recognition | None = part("how mass and speed are found", Recognition)

    @property
    def stateless(self) -> bool:
        return super().stateless and self.recognition is None

    @property
    def load_feedforward(self) -> bool:
        return self.loads == "known"

    def prepare(self, plant, design_plant):
        load = design_plant.case.loads[0]
        speeds = jnp.abs(load.speed)[None] if self.speeds is None else self.speeds
        design_one = super().prepare

        def design(mass, speed):
            return design_one(plant, _with_crossing_load(design_plant, mass, speed))

        schedules = jax.vmap(jax.vmap(design, (None, 0)), (0, None))(self.masses, speeds)
        identifier = (
            None if self.recognition is None else self.recognition.identifier(plant, design_plant)
        )
        given = jnp.stack([load.mass, jnp.abs(load.speed), load.entry_time])
        length, gravity = plant.case.beam.length, design_plant.case.run.gravity
        return GainScheduleGrid(schedules, self.masses, speeds, length, given, gravity, identifier)

    def command(self, memory, estimate, measurement, t):
        mass, speed, entry = memory.told
        speed_identified = jnp.ones((), bool)
        if memory.identifier is not None:
            identifier = memory.identifier.update(measurement, t)
            memory = eqx.tree_at(lambda m: m.identifier.fit, memory, identifier.fit)
            speed_identified, mass_identified = identifier.told(t)
            mass = jnp.where(mass_identified, identifier.mass, memory.masses[0])
            speed, entry = jnp.abs(identifier.speed), identifier.entry_time
        end = entry + memory.length / speed
        weights = jnp.zeros(0)
        if self.load_feedforward:
            clamped_mass = jnp.clip(mass, memory.masses[0], memory.masses[-1])
            weights = (clamped_mass * memory.gravity)[None]

        def command_of(schedule):
            stretched = dataclasses.replace(schedule, known=weights, start=entry, end=end)
            return super(ScheduledLQR, self).command(stretched, estimate, measurement, t)[0]

        commands = jax.vmap(jax.vmap(command_of))(memory.schedules)
        shares = (
            self._interpolation_weights(memory.masses, mass),
            self._interpolation_weights(memory.speeds, speed),
        )
        command = jnp.einsum("m,v,mva->a", *shares, commands)
        return jnp.where(speed_identified, command, 0.0), memory

    def _interpolation_weights(self, grid, value) -> Float[Array, " design"]:
        """What each design of a grid contributes at a value."""
        if self.between == "nearest":
            return jax.nn.one_hot(jnp.argmin(jnp.abs(grid - value)), grid.shape[0], dtype=float)
        ones = jnp.eye(grid.shape[0])
        return jax.vmap(lambda one: jnp.interp(value, grid, one))(ones)

    def validate(self, case):
        if len(case.loads) != 1 or any(
            getattr(load, name) is None for load in case.loads for name in ("mass", "speed")
        ):
            return "kind needs a single load, with a mass and a speed; or take another kind"
        if self.entries == "predicted":
            return "entries must be 'measured': the load is followed as told, or as recognised"
        for name in ("masses", "speeds"):
            values = getattr(self, name)
            if values is not None and (values.size == 0 or _not_positive(values)):
                return f"{name} must list at least one, and positive ones"
        if self.recognition is not None:
            if self.period is None:
                return "period must be given: the recognition of loads remembers"
            error = self.recognition.validate(case)
            if error is not None:
                return f"recognition.{error}"
        if self.speeds is not None:
            error = points_error(self, case, self.speeds[0])
            if error is not None:
                return error
        return super().validate(case)


def _not_positive(values) -> bool:
    return is_concrete(values) and bool(np.any(concrete(values) <= 0))


def _with_crossing_load(plant: Plant, mass, speed) -> Plant:
    """The model with another mass, which keeps another speed, in the direction of its load."""
    load = plant.case.loads[0]
    changed = eqx.tree_at(
        lambda x: (x.mass, x.speed, x.deceleration),
        load,
        (mass, jnp.sign(load.speed) * speed, jnp.zeros(())),
    )
    case = eqx.tree_at(lambda c: c.loads, plant.case, (changed,))
    return dataclasses.replace(plant, case=case, loads=load_set(case))
