"""Schedules of gains over the crossing of loads."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.gain_table import GainTable


class GainSchedule(eqx.Module):
    """Gains over a crossing from `start` to `end` (s), and the gain from then on.

    That dies away with a time constant `fade_time` (s), or does not if that is None. `load_weights` are the
    weights of the loads (N), which have columns of their own behind the states.
    """

    table: GainTable
    final_gain: Float[Array, "actuator column"]
    load_weights: Float[Array, " load"]
    start: Float[Array, ""]
    end: Float[Array, ""]
    fade_time: Float[Array, ""] | None = None

    def gain(self, t: Float[Array, ""]) -> Float[Array, "actuator column"]:
        """The gain at a time (s); zero before the first load enters."""
        crossing_share = (t - self.start) / (self.end - self.start)
        final_gain = self.final_gain
        if self.fade_time is not None:
            final_gain = final_gain * jnp.exp(-jnp.maximum(t - self.end, 0.0) / self.fade_time)
        gain = jnp.where(t < self.end, self.table(crossing_share), final_gain)
        return jnp.where(t < self.start, 0.0, gain)


def crossing_events(plant: Plant) -> Float[Array, " event"]:
    """Times (s) at which loads enter and leave, ascending; the run's end for loads that stay."""
    windows = [path.entry_exit_times() for path in plant.loads.trajectories]
    events = jnp.sort(jnp.array(windows).reshape(-1))
    last_event = jnp.max(jnp.where(events < NEVER, events, plant.case.run.duration))
    return jnp.minimum(events, last_event)
