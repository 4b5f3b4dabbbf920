"""Schedules of gains over the crossing of loads."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.state_space import LoadedBeam
from jaxbeam.numerics.gain_table import GainTable


class Schedule(eqx.Module):
    """Gains over a crossing from `start` to `end` (s), and the gain from then on.

    That dies away with a time constant `fade` (s), or does not if that is None. `known` are the
    weights of the loads (N), which have columns of their own behind the states.
    """

    table: GainTable
    rest: Float[Array, "actuator column"]
    known: Float[Array, " load"]
    start: Float[Array, ""]
    end: Float[Array, ""]
    fade: Float[Array, ""] | None = None

    def gain(self, t: Float[Array, ""]) -> Float[Array, "actuator column"]:
        """The gain at a time (s); zero before the first load enters."""
        share = (t - self.start) / (self.end - self.start)
        rest = self.rest
        if self.fade is not None:
            rest = rest * jnp.exp(-jnp.maximum(t - self.end, 0.0) / self.fade)
        gain = jnp.where(t < self.end, self.table(share), rest)
        return jnp.where(t < self.start, 0.0, gain)


def crossing(model: LoadedBeam) -> Float[Array, " event"]:
    """Times (s) at which loads enter and leave, ascending; the run's end for loads that stay."""
    windows = [path.window() for path in model.traffic.motions]
    events = jnp.sort(jnp.array(windows).reshape(-1))
    last = jnp.max(jnp.where(events < NEVER, events, model.case.run.duration))
    return jnp.minimum(events, last)
