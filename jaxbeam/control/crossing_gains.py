"""Gain tables over a crossing, for several masses and speeds, scheduled by one load or several.

A table holds designs k(m, v) of single loads. The law of section 5.3 of the thesis follows one
load, given or identified. Chapter 8 leaves open how such gains serve several loads, and cars of
varying speed: here the gains K of the state are averaged over the loads on the beam with their
masses as weights, and the commands for their weights W, fed forward by the gains K_f, are added:

    u = -(sum of m_i K(m_i, v_i, x_i) / sum of m_i) z - sum of K_f(m_i, v_i, x_i) W_i

Gains that vary while loads cross: of a finite horizon, or of the plant frozen at each time.

J = x(end)' F x(end) + integral of x'Qx + u'Ru,     u = -K(t) x     (thesis, eqs 3.3 to 3.11)
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.controller import ControlStep, EstimatedLoads
from jaxbeam.case.loads.base import MovingMass
from jaxbeam.case.trajectory import NEVER, has_come
from jaxbeam.control.load_identification import AbstractLoadSource
from jaxbeam.control.state_controller import AbstractStateLaw
from jaxbeam.model.contact import (
    contact_rows,
    has_prescribed_disturbance,
    prescribed_disturbance,
    vehicle_system,
)
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.finite_horizon import (
    CouplingFunction,
    GainTable,
    breakpoints_between,
    finite_horizon,
    finite_horizon_coupled,
    frozen_time_gains,
    uniform_fractions,
)
from jaxbeam.numerics.matrices import InputWeight, Square
from jaxbeam.numerics.stages import ConstantPlant, Coupling
from jaxbeam.runtime.arrays import Array, block_diag, set_at, vmap, xp


class GainSchedule(AbstractStateLaw):
    """u = -K(t) x with a table of gains K from `start` to `end` (s), and `final_gain` from then on.

    The final gain decays with a time constant `fade_time` (s), or stays if that is None. After
    the states of the beam x has the `vehicle_states` and, with `load_feedforward`, the weights of
    the loads (N), estimated ones or `load_weights`, with 1 for profile and forces over time, if
    there are any; else `load_weights` is empty.
    """

    table: GainTable
    final_gain: Float[Array, "actuator column"]
    load_weights: Float[Array, " load"]
    start: Float[Array, ""]
    end: Float[Array, ""]
    fade_time: Float[Array, ""] | None = None
    load_feedforward: bool = eqx.field(static=True, default=False)
    vehicle_states: int = eqx.field(static=True, default=0)

    @property
    def needs_vehicles(self):
        return self.vehicle_states > 0

    def gain(self, t: Float[Array, ""]) -> Float[Array, "actuator column"]:
        """Gain at a time (s); zero before the start."""
        fraction = (t - self.start) / (self.end - self.start)
        final_gain = self.final_gain
        if self.fade_time is not None:
            final_gain = final_gain * xp.exp(-xp.maximum(t - self.end, 0.0) / self.fade_time)
        gain = xp.where(has_come(self.end, t), final_gain, self.table(fraction))
        return xp.where(has_come(self.start, t), gain, 0.0)

    def step(self, state, estimate, measurement, t):
        load_weights = self.load_weights
        if self.load_feedforward and estimate.weights is not None:
            constant = load_weights[estimate.weights.shape[0] :]
            load_weights = xp.concatenate([estimate.weights, constant])
        vehicles = estimate.vehicles if self.vehicle_states else xp.zeros(0)
        x = xp.concatenate([estimate.state, vehicles, load_weights])
        return ControlStep(-self.gain(t) @ x, state)


def crossing_events(plant: Plant) -> Float[Array, " event"]:
    """Entry and exit times (s) of all loads, ascending; the end of the run for loads that stay."""
    events = xp.sort(plant.loads.entry_exit_times().reshape(-1))
    last_event = xp.max(xp.where(events < NEVER, events, plant.case.run.duration))
    return xp.minimum(events, last_event)


def frozen_gains(plant: Plant, points: int, Q: Square, R: InputWeight) -> GainTable:
    """Gains of the regulators of a plant frozen at each time, eqs (3.10) and (3.11) of the thesis.

    Their states are those of the beam, and of vehicles, which have no weight.
    """

    def system_at(t):
        return plant.A(t), plant.B(t)

    return frozen_time_gains(
        system_at,
        breakpoints_between(crossing_events(plant), uniform_fractions(points)),
        xp.pad(Q, (0, plant.vehicle_states)),
        R,
    )


def finite_horizon_gains(
    plant: Plant, points: int, Q: Square, R: InputWeight, F: Square, with_weights: bool
) -> tuple[GainTable, Float[Array, "breakpoint augmented augmented"]]:
    """Table of optimal gains for a plant, eqs (3.3) to (3.9), and P at its breakpoints.

    Their states are those of beam and vehicles and, `with_weights` of the loads, constants; see
    `Plant.augmented`. Only those of the beam have weights.
    """
    further = plant.augmented_start.shape[0] if with_weights else plant.vehicle_states
    Q, F = (xp.pad(weight, (0, further)) for weight in (Q, F))
    problem = crossing_events(plant), points, Q, R, F
    if plant.modal_model.state_count == 2 * plant.coordinate_scale.shape[0]:
        return finite_horizon_coupled(*crossing_plant(plant, with_weights), *problem)

    # The coupled method assumes gains that are polynomials within an interval, which those of an
    # actuator with a lag much shorter than the interval are not.
    def system_at(t):
        system = plant.augmented(t) if with_weights else plant.at(t)
        return system.A, system.B[:, : plant.commands]

    return finite_horizon(system_at, *problem)


def crossing_plant(plant: Plant, with_weights: bool) -> tuple[ConstantPlant, CouplingFunction]:
    """Plant without loads, and the coupling by forces at given times (s), in its states.

    These are the contact forces r and, with vehicles, the forces q of the surface on their springs;
    the states are those of beam and vehicles. With `with_weights` the weights W of the loads, and
    one for profile and forces over time, are further, constant states, as in `Plant.augmented`.
    The law is that of `contact_rows`.
    """
    modal_model, load_count = plant.modal_model, plant.weights.shape[0]
    states, vehicles = modal_model.state_count, plant.vehicle_states
    disturbed = with_weights and has_prescribed_disturbance(plant.loads)
    constants = load_count + disturbed if with_weights else 0
    rates = modal_model.rate_index
    unloaded, added = plant.unloaded, vehicles + constants
    to_modal, command_rows = plant.to_modal(xp.eye(states)), modal_model.command_matrix[rates]
    directions = plant.from_modal(xp.eye(states)[:, rates])
    state_matrix, sprung = unloaded.A, _sprung_wheels(plant.loads)
    if vehicles:
        A, B, _ = vehicle_system(plant.loads)
        state_matrix, directions = block_diag(state_matrix, A), block_diag(directions, B[:, sprung])
    unloaded_plant = ConstantPlant(
        xp.pad(state_matrix, (0, constants)),
        xp.pad(unloaded.B, ((0, added), (0, 0))),
        xp.pad(directions, ((0, states + added - directions.shape[0]), (0, 0))),
    )

    def contact_coupling(times):
        contact = contact_rows(modal_model, plant.loads, times)
        shape, mass = contact.shape, plant.loads.inertia
        force_rows = xp.concatenate(
            [-contact.force[..., :states] @ to_modal, -contact.force[..., states:]], axis=-1
        )
        constant_columns = -xp.eye(load_count, constants)
        constant_columns = xp.broadcast_to(
            constant_columns, (*times.shape, *constant_columns.shape)
        )
        prescribed = prescribed_disturbance(plant.loads, times) if disturbed else None
        if prescribed is not None:
            constant_columns = set_at(constant_columns, np.s_[..., -1], -prescribed[0])
        distribution = xp.swapaxes(shape, -1, -2)
        coupling = Coupling(
            force_distribution=distribution,
            force_state_rows=xp.concatenate([force_rows, constant_columns], axis=-1),
            command_feedthrough=-mass * (shape @ command_rows),
            force_feedthrough=mass * (shape @ distribution),
        )
        if not vehicles:
            return coupling
        assert contact.surface is not None
        surface_rows = contact.surface[..., sprung, :] @ to_modal
        surface_rows = xp.pad(surface_rows, [(0, 0)] * (surface_rows.ndim - 1) + [(0, added)])
        if prescribed is not None:
            surface_rows = set_at(surface_rows, np.s_[..., -1], prescribed[1][..., sprung])
        return _with_springs(coupling, surface_rows)

    return unloaded_plant, contact_coupling


def _with_springs(coupling: Coupling, surface_rows) -> Coupling:
    """Coupling with the forces on springs of the vehicles as further forces."""
    count, lead = surface_rows.shape[-2], [(0, 0)] * (surface_rows.ndim - 2)
    identity = xp.broadcast_to(xp.eye(count), (*surface_rows.shape[:-2], count, count))
    wheels = coupling.force_distribution.shape[-1]
    below = xp.pad(identity, [*lead, (0, 0), (wheels, 0)])
    contact = xp.pad(coupling.force_distribution, [*lead, (0, 0), (0, count)])
    return Coupling(
        force_distribution=xp.concatenate([contact, below], axis=-2),
        force_state_rows=xp.concatenate([coupling.force_state_rows, surface_rows], axis=-2),
        command_feedthrough=xp.pad(coupling.command_feedthrough, [*lead, (0, count), (0, 0)]),
        force_feedthrough=xp.pad(coupling.force_feedthrough, [*lead, (0, count), (0, count)]),
    )


def _sprung_wheels(loads: LoadSet) -> np.ndarray:
    """Indices of the wheels of vehicles."""
    parts = [np.arange(group.wheels.start, group.wheels.stop) for group in loads.wheels.vehicles]
    return np.concatenate(parts) if parts else np.zeros(0, int)


def designs_of(
    schedule: Callable[[Plant], GainSchedule],
    plant: Plant,
    masses: Float[Array, " mass"],
    speeds: Float[Array, " speed"],
) -> GainSchedule:
    """Gain schedules (mass, speed) of a design plant, one for each mass and speed of its load."""

    def design(mass, speed):
        return schedule(with_crossing_load(plant, mass, speed))

    over_speeds = jax.vmap(design, (None, 0))
    return jax.vmap(over_speeds, (0, None))(jnp.asarray(masses), jnp.asarray(speeds))


def with_crossing_load(plant: Plant, mass, speed) -> Plant:
    """Plant whose load has another mass (kg) and constant speed (m/s), in the same direction.

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
        # Interpolated in proportion to the mass between designs that differ in it alone.
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
        weights = self._interpolation(self.masses, mass), self._interpolation(self.speeds, speed)
        command = xp.einsum("m,v,mva->a", *weights, commands)
        return ControlStep(xp.where(load.speed_identified, command, 0.0), state)

    def _interpolation(self, grid, value) -> Float[Array, " design"]:
        """Weight of each design of a grid at a value."""
        if self.nearest:
            return xp.asarray(np.arange(grid.shape[0]) == xp.argmin(xp.abs(grid - value)), float)
        return _hat_weights(grid, value)


class ReadLoads(NamedTuple):
    """Loads that schedule the gains: their clocks, speeds (m/s), masses (kg) and weights (N).

    The clock is negative before entry, the fraction of the beam travelled on it, and 1 plus the
    time since the exit (s) after.
    """

    clock: Float[Array, " load"]
    speeds: Float[Array, " load"]
    on_beam: Bool[Array, " load"]
    masses: Float[Array, " load"]
    weights: Float[Array, " load"]


class PositionGainLaw(AbstractStateLaw):
    """Law whose gains are scheduled by the positions of the loads, from designs for single loads.

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
        travelled = xp.clip(self._travelled(positions), 0.0, 1.0)
        since_exit = xp.maximum(t - leave, 0.0)
        clock = xp.where(entered, xp.where(left, 1.0 + since_exit, travelled), -1.0)
        on_beam = entered & ~left
        return ReadLoads(clock, xp.abs(speeds), on_beam, self.load_masses, self.load_weights)

    def estimated_loads(self, loads: EstimatedLoads) -> ReadLoads:
        """The loads of an estimate; those that have left did so at their present speed."""
        travelled, speeds = self._travelled(loads.positions), xp.abs(loads.speeds)
        length = self.load_set.trajectories[0].length
        since_exit = xp.maximum(travelled - 1.0, 0.0) * length
        moving = speeds > 0
        since_exit = xp.where(moving, since_exit / xp.where(moving, speeds, 1.0), 0.0)
        clock = xp.where(travelled < 0, -1.0, xp.minimum(travelled, 1.0) + since_exit)
        on_beam = (travelled >= 0) & (travelled < 1)
        weights = loads.masses * self.load_weights / self.load_masses
        return ReadLoads(clock, speeds, on_beam, loads.masses, weights)

    def _travelled(self, positions):
        """Fraction of the beam that loads at positions (m) have travelled."""
        path = self.load_set.trajectories[0]
        from_left = positions / path.length
        return xp.where(path.direction() < 0, 1.0 - from_left, from_left)

    def load_gains(self, loads: ReadLoads) -> Float[Array, "load actuator column"]:
        """Gain of each load, as if it were alone."""

        def of_load(clock, mass, speed):
            def gain(schedule):
                start, end = xp.zeros(()), xp.ones(())
                return dataclasses.replace(schedule, start=start, end=end).gain(clock)

            gains = vmap(vmap(gain))(self.schedules)
            weights = _hat_weights(self.masses, mass), _hat_weights(self.speeds, speed)
            return xp.einsum("m,v,mvac->ac", *weights, gains)

        return vmap(of_load)(loads.clock, loads.masses, loads.speeds)

    def combined(
        self, loads: ReadLoads
    ) -> tuple[Float[Array, "actuator state"], Float[Array, " actuator"]]:
        """Gain of the state for the loads together, and commands fed forward for their weights."""
        gains, on_beam = self.load_gains(loads), loads.on_beam
        counted = xp.where(xp.any(on_beam), on_beam, loads.clock >= 1)
        weights = xp.where(counted, loads.masses, 0.0)
        total = xp.sum(weights)
        weights = weights / xp.where(total > 0, total, 1.0)
        states = gains.shape[-1] - self.schedules.load_weights.shape[-1]
        forward = xp.zeros(gains.shape[1])
        if self.schedules.load_feedforward:
            forward = -xp.where(on_beam, loads.weights, 0.0) @ gains[..., states]
        return xp.einsum("l,lac->ac", weights, gains[..., :states]), forward

    def step(self, state, estimate, measurement, t):
        followed = estimate.loads
        loads = self.loads_at(t) if followed is None else self.estimated_loads(followed)
        gain, forward = self.combined(loads)
        return ControlStep(forward - gain @ estimate.state, state)


def _hat_weights(grid, value) -> Float[Array, " design"]:
    """Weights of the designs of a grid in linear interpolation at a value."""
    return vmap(lambda unit: xp.interp(value, grid, unit))(np.eye(grid.shape[0]))
