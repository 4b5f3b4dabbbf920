"""Gains that vary while loads cross: of a finite horizon, or of the plant frozen at each time.

J = x(end)' F x(end) + integral of x'Qx + u'Ru,     u = -K(t) x     (thesis, eqs 3.3 to 3.11)
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import ControlStep
from jaxbeam.case.trajectory import NEVER, has_come
from jaxbeam.control.state_controller import AbstractStateLaw
from jaxbeam.model.contact import (
    contact_rows,
    has_known_disturbance,
    known_disturbance,
    vehicle_system,
)
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.coupled_stages import ConstantPlant, Coupling
from jaxbeam.numerics.finite_horizon import (
    CouplingFunction,
    finite_horizon,
    finite_horizon_coupled,
)
from jaxbeam.numerics.gain_table import (
    GainTable,
    breakpoints_between,
    frozen_time_gains,
    uniform_fractions,
)
from jaxbeam.numerics.matrices import InputWeight, Square
from jaxbeam.runtime.arrays import Array, block_diag, set_at, xp


class GainSchedule(AbstractStateLaw):
    """u = -K(t) x with a table of gains K from `start` to `end` (s), and `final_gain` from then on.

    The final gain decays with a time constant `fade_time` (s), or stays if that is None. After
    the states of the beam x has the `vehicle_states` and, with `load_feedforward`, the weights of
    the loads (N), estimated ones or `load_weights`, with 1 for other known disturbances, if there
    are any; else `load_weights` is empty.
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
        crossing_share = (t - self.start) / (self.end - self.start)
        final_gain = self.final_gain
        if self.fade_time is not None:
            final_gain = final_gain * xp.exp(-xp.maximum(t - self.end, 0.0) / self.fade_time)
        gain = xp.where(has_come(self.end, t), final_gain, self.table(crossing_share))
        return xp.where(has_come(self.start, t), gain, 0.0)

    def step(self, state, estimate, measurement, t):
        load_weights = self.load_weights
        if self.load_feedforward and estimate.weights is not None:
            known = load_weights[estimate.weights.shape[0] :]
            load_weights = xp.concatenate([estimate.weights, known])
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
    one for what else is known to disturb, are further, constant states, as in `Plant.augmented`.
    The law is that of `contact_rows`.
    """
    modal_model, load_count = plant.modal_model, plant.weights.shape[0]
    states, vehicles = modal_model.state_count, plant.vehicle_states
    disturbed = with_weights and has_known_disturbance(plant.loads)
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
        known = known_disturbance(plant.loads, times) if disturbed else None
        if known is not None:
            constant_columns = set_at(constant_columns, np.s_[..., -1], -known[0])
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
        if known is not None:
            surface_rows = set_at(surface_rows, np.s_[..., -1], known[1][..., sprung])
        return _with_springs(coupling, surface_rows)

    return unloaded_plant, contact_coupling


def _with_springs(coupling: Coupling, surface_rows) -> Coupling:
    """Coupling with the forces on springs of the vehicles as further forces."""
    count, lead = surface_rows.shape[-2], [(0, 0)] * (surface_rows.ndim - 2)
    identity = xp.broadcast_to(xp.eye(count), (*surface_rows.shape[:-2], count, count))
    wheels = coupling.force_distribution.shape[-1]
    below = xp.pad(identity, [*lead, (0, 0), (wheels, 0)])
    beside = xp.pad(coupling.force_distribution, [*lead, (0, 0), (0, count)])
    return Coupling(
        force_distribution=xp.concatenate([beside, below], axis=-2),
        force_state_rows=xp.concatenate([coupling.force_state_rows, surface_rows], axis=-2),
        command_feedthrough=xp.pad(coupling.command_feedthrough, [*lead, (0, count), (0, 0)]),
        force_feedthrough=xp.pad(coupling.force_feedthrough, [*lead, (0, count), (0, count)]),
    )


def _sprung_wheels(loads: LoadSet) -> np.ndarray:
    """Indices of the wheels of vehicles."""
    parts = [np.arange(group.wheels.start, group.wheels.stop) for group in loads.wheels.vehicles]
    return np.concatenate(parts) if parts else np.zeros(0, int)
