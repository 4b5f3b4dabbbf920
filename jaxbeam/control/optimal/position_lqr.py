"""Finite-horizon gains of one load, read at the measured positions of any number of loads.

Chapter 8 of the thesis leaves open how gains computed for single masses serve several, and cars of
varying speed. Here the gains K of the state are averaged over the loads on the beam with their
masses as weights, and the commands for their weights W, fed forward by the gains K_f, are added:

    u = -(sum of m_i K(m_i, v_i, x_i) / sum of m_i) z - sum of K_f(m_i, v_i, x_i) W_i
"""

import dataclasses
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.controller import ControlStep
from jaxbeam.case.estimator import EstimatedLoads
from jaxbeam.case.fields import INCREASING, choice, concrete, is_concrete, number
from jaxbeam.case.loads.base import trajectory
from jaxbeam.case.loads.mass import MovingMass
from jaxbeam.control.optimal.crossing_lqr import AbstractFiniteHorizonRegulator, interval_error
from jaxbeam.control.optimal.gain_schedules import GainSchedule
from jaxbeam.control.optimal.scheduled_lqr import with_crossing_load
from jaxbeam.control.state_law import AbstractStateLaw
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.runtime.arrays import Array, xp


class PositionLQR(AbstractFiniteHorizonRegulator):
    """Optimal gains of single loads, read by the positions of one load or several.

    A `FiniteLQR` is designed for each of the `masses` and `speeds` (magnitudes; that of the first
    load in the design if left out), alone on the beam at constant speed. Each load of the case
    reads the tables, interpolated linearly, at its measured position and present speed, which may
    change, rather than at a time. Of several loads on the beam the gains of the state are averaged
    with their masses as weights; with loads "known" the commands for their weights, in proportion
    to the masses, are added. With none on the beam, `after` holds for those that have left. An
    estimator that follows the loads, `kalman-extended`, gives their masses, positions and speeds.

    >>> import jaxbeam as jb
    >>> weights = {"state_weight": [1e4, 1.0], "command_weight": [1e-3]}
    >>> print(jb.PositionLQR(**weights, masses=[0.2, 0.4], loads="known").masses)
    [0.2 0.4]
    """

    kind: ClassVar[str] = "lqr-position"

    masses: Float[Array, " mass"] = number("kg", "masses of the designs", INCREASING, kw_only=True)
    speeds: Float[Array, " speed"] | None = number(
        "m/s", "speeds of the designs", INCREASING, default=None
    )
    loads: str = choice("weights of the loads", "ignored", "known", default="ignored")

    @property
    def load_feedforward(self) -> bool:
        return self.loads == "known"

    def design_state_law(self, plant, design_plant):
        case, direction = design_plant.case, plant.loads.trajectories[0].direction()
        case = eqx.tree_at(lambda c: c.loads, case, (MovingMass(mass=1.0, speed=direction),))
        loads = load_set(case, design_plant.modal_model.modes.layout)
        alone = dataclasses.replace(design_plant, case=case, loads=loads)
        speeds = self.speeds
        if speeds is None:
            speeds = xp.abs(design_plant.case.loads[0].speed)[None]

        def design(mass, speed):
            return self.gain_schedule(alone, with_crossing_load(alone, mass, speed))

        schedules = jax.vmap(jax.vmap(design, (None, 0)), (0, None))(
            jnp.asarray(self.masses), jnp.asarray(speeds)
        )
        gravity = plant.case.run.gravity
        masses = jnp.stack([jnp.asarray(load.total_mass(gravity)) for load in plant.case.loads])
        return PositionGainLaw(
            schedules, self.masses, speeds, masses, masses * gravity, plant.loads
        )

    def validate(self, case):
        gravity = case.run.gravity
        if case.profile is not None:
            return "kind is for beams without a profile; take 'lqr-scheduled' or 'lqr-augmented'"
        for i, load in enumerate(case.loads):
            vehicle = load.vehicle(gravity)
            if load.total_mass(gravity) is None:
                return f"kind needs loads with a mass; loads.{i} has none"
            if vehicle.names or vehicle.offsets.shape[0] != 1:
                return f"kind needs loads of one wheel; loads.{i} has more: take 'lqr-augmented'"
        if case.loads and case.loads[0].speed is None and self.speeds is None:
            return "speeds must be given where the first load has a table of positions"
        paths = [trajectory(load, case.beam.length) for load in case.loads]
        directions = [path.direction() for path in paths]
        if all(map(is_concrete, directions)) and len({float(concrete(x)) for x in directions}) > 1:
            return "kind needs loads that all travel in one direction; take 'lqr-augmented'"
        for name in ("masses", "speeds"):
            values = getattr(self, name)
            if values is not None and (
                values.size == 0 or (is_concrete(values) and bool(np.any(concrete(values) <= 0)))
            ):
                return f"{name} must list at least one, and positive ones"
        if self.entries == "predicted":
            return "entries must be 'measured': the tables are read by the positions of the loads"
        error = None
        if case.loads and self.speeds is not None:
            error = interval_error(self, case, self.speeds[0])
        return error or super().validate(case)


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
        clock = jnp.where(t < leave, jnp.clip(self._share(positions), 0.0, 1.0), 1.0 + t - leave)
        clock = jnp.where(t < entry, -1.0, clock)
        on_beam = (entry <= t) & (t < leave)
        return ReadLoads(clock, jnp.abs(speeds), on_beam, self.load_masses, self.load_weights)

    def estimated_loads(self, loads: EstimatedLoads) -> ReadLoads:
        """The loads as an estimator follows them; they have left at their present speed."""
        share, speeds = self._share(loads.positions), jnp.abs(loads.speeds)
        length = self.load_set.trajectories[0].length
        since_exit = jnp.maximum(share - 1.0, 0.0) * length
        moving = speeds > 0
        since_exit = jnp.where(moving, since_exit / jnp.where(moving, speeds, 1.0), 0.0)
        clock = jnp.where(share < 0, -1.0, jnp.minimum(share, 1.0) + since_exit)
        on_beam = (share >= 0) & (share < 1)
        weights = loads.masses * self.load_weights / self.load_masses
        return ReadLoads(clock, speeds, on_beam, loads.masses, weights)

    def _share(self, positions):
        """Share of the beam that loads at positions (m) have travelled."""
        path = self.load_set.trajectories[0]
        share = positions / path.length
        return jnp.where(path.direction() < 0, 1.0 - share, share)

    def load_gains(self, loads: ReadLoads) -> Float[Array, "load actuator column"]:
        """Gain that each load reads, as if it were alone."""

        def of_load(clock, mass, speed):
            def gain(schedule):
                start, end = jnp.zeros(()), jnp.ones(())
                return dataclasses.replace(schedule, start=start, end=end).gain(clock)

            gains = jax.vmap(jax.vmap(gain))(self.schedules)
            shares = _hat_weights(self.masses, mass), _hat_weights(self.speeds, speed)
            return jnp.einsum("m,v,mvac->ac", *shares, gains)

        return jax.vmap(of_load)(loads.clock, loads.masses, loads.speeds)

    def combined(
        self, loads: ReadLoads
    ) -> tuple[Float[Array, "actuator state"], Float[Array, " actuator"]]:
        """Gain of the state, and commands that are fed forward, for some loads."""
        gains, on_beam = self.load_gains(loads), loads.on_beam
        counted = jnp.where(jnp.any(on_beam), on_beam, loads.clock >= 1)
        shares = jnp.where(counted, loads.masses, 0.0)
        total = jnp.sum(shares)
        shares = shares / jnp.where(total > 0, total, 1.0)
        states = gains.shape[-1] - self.schedules.load_weights.shape[-1]
        forward = jnp.zeros(gains.shape[1])
        if self.schedules.load_feedforward:
            forward = -jnp.where(on_beam, loads.weights, 0.0) @ gains[..., states]
        return jnp.einsum("l,lac->ac", shares, gains[..., :states]), forward

    def step(self, state, estimate, measurement, t):
        followed = estimate.loads
        loads = self.loads_at(t) if followed is None else self.estimated_loads(followed)
        gain, forward = self.combined(loads)
        return ControlStep(forward - gain @ estimate.state, state)


def _hat_weights(grid, value) -> Float[Array, " design"]:
    """Weights of the designs of a grid in linear interpolation at a value."""
    return jax.vmap(lambda unit: jnp.interp(value, grid, unit))(jnp.eye(grid.shape[0]))
