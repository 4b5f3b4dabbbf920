"""Finite-horizon gains of several masses and speeds, read by one load or by several.

A table holds designs k(m, v) of single loads. The law of section 5.3 of the thesis follows one
load, given or identified. Chapter 8 leaves open how such gains serve several loads, and cars of
varying speed: here the gains K of the state are averaged over the loads on the beam with their
masses as weights, and the commands for their weights W, fed forward by the gains K_f, are added:

    u = -(sum of m_i K(m_i, v_i, x_i) / sum of m_i) z - sum of K_f(m_i, v_i, x_i) W_i
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.controller import ControlStep
from jaxbeam.case.estimator import EstimatedLoads
from jaxbeam.case.loads.point import MovingMass
from jaxbeam.case.trajectory import has_come
from jaxbeam.control.load_identification import AbstractLoadSource
from jaxbeam.control.optimal.crossing_gains import GainSchedule
from jaxbeam.control.state_controller import AbstractStateLaw
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.state_space import Plant
from jaxbeam.runtime.arrays import Array, vmap, xp


def designs_of(
    schedule: Callable[[Plant], GainSchedule],
    plant: Plant,
    masses: Float[Array, " mass"],
    speeds: Float[Array, " speed"],
) -> GainSchedule:
    """Gain schedules (mass, speed) of a design plant whose load has other masses and speeds."""

    def design(mass, speed):
        return schedule(with_crossing_load(plant, mass, speed))

    over_speeds = jax.vmap(design, (None, 0))
    return jax.vmap(over_speeds, (0, None))(jnp.asarray(masses), jnp.asarray(speeds))


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


def with_single_mass(plant: Plant, direction: Float[Array, ""]) -> Plant:
    """Plant under a mass of 1 kg alone, which travels at 1 m/s in a direction (1 or -1)."""
    load = (MovingMass(mass=1.0, speed=direction),)
    case = eqx.tree_at(lambda c: c.loads, plant.case, load)
    loads = load_set(case, plant.modal_model.modes.layout)
    return dataclasses.replace(plant, case=case, loads=loads)


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
        mass = xp.where(load.mass_identified, load.mass, self.masses[0])
        speed, entry = xp.abs(load.speed), load.entry_time
        end = entry + self.length / speed
        # In proportion to the mass between the designs, which differ in it alone.
        clamped_mass = xp.clip(mass, self.masses[0], self.masses[-1])
        lightest = self.schedules.load_weights[0, 0]
        constant = xp.arange(lightest.shape[0]) >= self.weight_count
        load_weights = xp.where(constant, lightest, lightest * clamped_mass / self.masses[0])

        def command_of(schedule):
            stretched = dataclasses.replace(
                schedule, load_weights=load_weights, start=entry, end=end
            )
            return stretched.step((), estimate, measurement, t).command

        commands = vmap(vmap(command_of))(self.schedules)
        shares = self._interpolation(self.masses, mass), self._interpolation(self.speeds, speed)
        command = xp.einsum("m,v,mva->a", *shares, commands)
        return ControlStep(xp.where(load.speed_identified, command, 0.0), state)

    def _interpolation(self, grid, value) -> Float[Array, " design"]:
        """Weight of each design of a grid at a value."""
        if self.nearest:
            return xp.asarray(np.arange(grid.shape[0]) == xp.argmin(xp.abs(grid - value)), float)
        unit_vectors = np.eye(grid.shape[0])
        return vmap(lambda weights: xp.interp(value, grid, weights))(unit_vectors)


class ReadLoads(NamedTuple):
    """Loads that read the tables: their clocks, speeds (m/s), masses (kg) and weights (N).

    The clock is negative before entry, the share of the beam travelled on it, and 1 plus the time
    since the exit (s) after.
    """

    clock: Float[Array, " load"]
    speeds: Float[Array, " load"]
    on_beam: Bool[Array, " load"]
    masses: Float[Array, " load"]
    weights: Float[Array, " load"]


class PositionGainLaw(AbstractStateLaw):
    """Gain schedules (mass, speed) of single loads, and the loads that read them.

    `load_masses` (kg) and `load_weights` (N) are those of the loads, whose positions are those of
    `load_set`; loads of an estimate take their place.
    """

    schedules: GainSchedule
    masses: Float[Array, " mass"]
    speeds: Float[Array, " speed"]
    load_masses: Float[Array, " load"]
    load_weights: Float[Array, " load"]
    load_set: LoadSet

    def loads_at(self, t: Float[Array, ""]) -> ReadLoads:
        """The loads of the case at t (s)."""
        positions, speeds, _ = self.load_set.kinematics(t)
        entry, leave = self.load_set.entry_exit_times().T
        entered, left = has_come(entry, t), has_come(leave, t)
        share, since_exit = xp.clip(self._share(positions), 0.0, 1.0), xp.maximum(t - leave, 0.0)
        clock = xp.where(entered, xp.where(left, 1.0 + since_exit, share), -1.0)
        on_beam = entered & ~left
        return ReadLoads(clock, xp.abs(speeds), on_beam, self.load_masses, self.load_weights)

    def estimated_loads(self, loads: EstimatedLoads) -> ReadLoads:
        """The loads as an estimator follows them; they have left at their present speed."""
        share, speeds = self._share(loads.positions), xp.abs(loads.speeds)
        length = self.load_set.trajectories[0].length
        since_exit = xp.maximum(share - 1.0, 0.0) * length
        moving = speeds > 0
        since_exit = xp.where(moving, since_exit / xp.where(moving, speeds, 1.0), 0.0)
        clock = xp.where(share < 0, -1.0, xp.minimum(share, 1.0) + since_exit)
        on_beam = (share >= 0) & (share < 1)
        weights = loads.masses * self.load_weights / self.load_masses
        return ReadLoads(clock, speeds, on_beam, loads.masses, weights)

    def _share(self, positions):
        """Share of the beam that loads at positions (m) have travelled."""
        path = self.load_set.trajectories[0]
        share = positions / path.length
        return xp.where(path.direction() < 0, 1.0 - share, share)

    def load_gains(self, loads: ReadLoads) -> Float[Array, "load actuator column"]:
        """Gain that each load reads, as if it were alone."""

        def of_load(clock, mass, speed):
            def gain(schedule):
                start, end = xp.zeros(()), xp.ones(())
                return dataclasses.replace(schedule, start=start, end=end).gain(clock)

            gains = vmap(vmap(gain))(self.schedules)
            shares = _hat_weights(self.masses, mass), _hat_weights(self.speeds, speed)
            return xp.einsum("m,v,mvac->ac", *shares, gains)

        return vmap(of_load)(loads.clock, loads.masses, loads.speeds)

    def combined(
        self, loads: ReadLoads
    ) -> tuple[Float[Array, "actuator state"], Float[Array, " actuator"]]:
        """Gain of the state, and commands that are fed forward, for some loads."""
        gains, on_beam = self.load_gains(loads), loads.on_beam
        counted = xp.where(xp.any(on_beam), on_beam, loads.clock >= 1)
        shares = xp.where(counted, loads.masses, 0.0)
        total = xp.sum(shares)
        shares = shares / xp.where(total > 0, total, 1.0)
        states = gains.shape[-1] - self.schedules.load_weights.shape[-1]
        forward = xp.zeros(gains.shape[1])
        if self.schedules.load_feedforward:
            forward = -xp.where(on_beam, loads.weights, 0.0) @ gains[..., states]
        return xp.einsum("l,lac->ac", shares, gains[..., :states]), forward

    def step(self, state, estimate, measurement, t):
        followed = estimate.loads
        loads = self.loads_at(t) if followed is None else self.estimated_loads(followed)
        gain, forward = self.combined(loads)
        return ControlStep(forward - gain @ estimate.state, state)


def _hat_weights(grid, value) -> Float[Array, " design"]:
    """Weights of the designs of a grid in linear interpolation at a value."""
    return vmap(lambda unit: xp.interp(value, grid, unit))(np.eye(grid.shape[0]))
