"""Commands that go with the load: a table over its way, clocked by two gates.

Where voltage and not knowledge is the limit, a load need not be weighed: what a light one may be
given at each place does for a heavy one too. It is enough to know where the load is.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, concrete, is_concrete, number
from jaxbeam.case.loads import trajectory
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.state_space import Plant


class Passage(AbstractController):
    """Commands tabulated over the share of the way of a load that two gates have announced.

    The commands at the `shares` (0 at the end where the load enters, 1 at the other) are joined by
    straight lines and zero outside; those of several loads are added. Gates may be before the beam
    (a negative position if loads enter at the left). A load is taken to keep the speed that it
    has between them, and commands begin when it has passed the second. The table is read `lead`
    seconds ahead of the load, to make up for delay and hold. No sensor of the beam and no mass is
    used: there is no loop that could become unstable.
    """

    gates: Float[Array, "2"] = number("m", "where the gates are, in the order they are passed")
    shares: Float[Array, " knot"] = number("1", "shares of the way", INCREASING)
    values: Float[Array, "actuator knot"] = number(
        "unit of a command", "a list of commands for each actuator"
    )
    lead: Float[Array, ""] = number(
        "s", "how far ahead of the load the table is read", NOT_NEGATIVE, default=0.0
    )

    @property
    def open_loop(self) -> bool:
        return True

    @property
    def stateless(self) -> bool:
        return True

    def validate(self, case):
        if self.period is None:
            return "period must be given: kind 'passage' acts at its ticks"
        if not case.loads:
            return "kind needs loads that pass the gates; add one, or take kind 'prescribed'"
        if self.values.shape != (len(case.actuators), self.shares.shape[0]):
            return (
                f"values must have for each of {len(case.actuators)} actuators as many entries as"
                f" shares has, {self.shares.shape[0]}; they are of shape {self.values.shape}"
            )
        if not all(is_concrete(leaf) for leaf in jax.tree.leaves((self.gates, case))):
            return None
        if np.any(~(np.diff(_gate_times(self.gates, case.loads, case.beam.length)) > 0)):
            return "gates must be two places that every load passes, the first before the other"
        return None

    def init(self, plant: Plant):
        gate_times = jnp.stack(
            [path.passage_times(self.gates)[:2] for path in plant.loads.trajectories]
        )
        return gate_times, plant.case.beam.length

    def step(self, memory, measurement, t):
        gate_times, length = memory
        speeds = jnp.diff(self.gates) / jnp.diff(gate_times, axis=1)[:, 0]
        gate_distance = jnp.where(speeds < 0, length - self.gates[1], self.gates[1])
        distance = gate_distance + (t + self.lead - gate_times[:, 1]) * jnp.abs(speeds)

        def interpolate(row):
            return jnp.interp(distance / length, self.shares, row, left=0.0, right=0.0)

        commands = jnp.where(t >= gate_times[:, 1], jax.vmap(interpolate)(self.values), 0.0)
        return jnp.sum(commands, axis=1), memory


def _gate_times(gates, loads, length) -> Float[np.ndarray, "load 2"]:
    """When loads pass the gates (s), NaN where they do not."""
    found = np.stack(
        [concrete(trajectory(load, length).passage_times(gates))[:2] for load in loads]
    )
    return np.where(found < NEVER, found, np.nan)
