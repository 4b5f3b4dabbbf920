"""Gain schedules over the crossing of loads, as control laws."""

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.controller import ControlStep
from jaxbeam.case.trajectory import NEVER
from jaxbeam.control.state_law import AbstractStateLaw
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.gain_table import GainTable
from jaxbeam.runtime.arrays import Array, xp


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
        gain = xp.where(t < self.end, self.table(crossing_share), final_gain)
        return xp.where(t < self.start, 0.0, gain)

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
