"""Feedback of readings with gains k(m) over the mass of the load, told or recognised: Fig. 6.7.

What gains to schedule, `jaxbeam.analysis.derived_gains` works out.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import INCREASING, choice, concrete, count, is_concrete, number, part
from jaxbeam.control.feedback import Feedback, pairing_error
from jaxbeam.control.load_identification import Recognition
from jaxbeam.control.load_update import AbstractLoadIdentifier


class ScheduledFeedbackState(eqx.Module):
    """Memory of `ScheduledFeedback`: the mass (kg) as it is told, and what recognises it."""

    mass: Float[Array, ""]
    identifier: AbstractLoadIdentifier | None


class ScheduledFeedback(AbstractController):
    """Each actuator answers the reading y of its own sensor: u = -k(m) y |y|^(power - 1).

    The first actuator listens to the first sensor, the second to the second, and so on. Each has a
    row of `gains`, one for each of the `masses` m of the load. Between these they are
    "interpolated" linearly, or, "stepped", kept from each mass to the next as in Fig. 6.7 of the
    thesis; beyond the first and last they stay. The mass is that of the single load of the case,
    or what the `recognition` finds; until that has told it, the lightest is assumed.
    """

    masses: Float[Array, " mass"] = number("kg", "masses for which there are gains", INCREASING)
    gains: Float[Array, "actuator mass"] = number(
        "command per reading^power", "a list for each actuator, a gain for each mass"
    )
    power: int = count("power of the reading", default=1)
    between: str = choice("between the masses", "interpolated", "stepped", default="interpolated")
    recognition: Recognition | None = part("how the mass is found", Recognition)

    @property
    def stateless(self) -> bool:
        return self.recognition is None

    def validate(self, case):
        if len(case.loads) != 1 or case.loads[0].mass is None:
            return "kind needs a single load, with a mass; or take kind 'feedback'"
        if self.masses.size == 0 or (
            is_concrete(self.masses) and np.any(concrete(self.masses) <= 0)
        ):
            return "masses must list at least one, and positive ones"
        if self.gains.shape[1] != self.masses.shape[0]:
            return (
                f"gains must list in each row a gain for each of {self.masses.shape[0]} masses,"
                f" not {self.gains.shape[1]}"
            )
        error = pairing_error(self.gains[:, 0], case)
        if error is not None or self.recognition is None:
            return error
        if self.period is None:
            return "period must be given: the recognition of loads remembers"
        error = self.recognition.validate(case)
        return None if error is None else f"recognition.{error}"

    def init(self, plant: Any) -> ScheduledFeedbackState:
        identifier = None if self.recognition is None else self.recognition.identifier(plant, plant)
        return ScheduledFeedbackState(jnp.asarray(plant.case.loads[0].mass), identifier)

    def gains_at(self, mass: Float[Array, ""]) -> Float[Array, " actuator"]:
        """The gains for a mass (kg)."""
        if self.between == "interpolated":
            return jax.vmap(lambda row: jnp.interp(mass, self.masses, row))(self.gains)
        last = self.masses.shape[0] - 1
        interval = jnp.searchsorted(self.masses, mass, side="right") - 1
        return self.gains[:, jnp.clip(interval, 0, last)]

    def step(self, memory, measurement, t):
        mass = memory.mass
        if memory.identifier is not None:
            identifier = memory.identifier.update(measurement, t)
            memory = eqx.tree_at(lambda m: m.identifier.fit, memory, identifier.fit)
            mass = jnp.where(identifier.told(t)[1], identifier.mass, self.masses[0])
        law = Feedback(self.gains_at(mass), self.power)
        return law.step(None, measurement, t)[0], memory
