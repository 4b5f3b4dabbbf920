"""Feedback of what the sensors read, through a power law."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.controller import AbstractController
from jaxbeam.fields import count, number


class Feedback(AbstractController):
    """Each actuator answers the reading y of its own sensor: u = -gain y |y|^(power - 1).

    The first actuator listens to the first sensor, the second to the second, and so on; power 1
    is linear feedback, 3 the cubic law of chapter 6 of the thesis (corrected sign: eq. 2.46 with
    u = -k w).
    """

    gains: Float[Array, " actuator"] = number(
        "command per reading^power", "one gain for each actuator"
    )
    power: int = count("power of the reading", default=1)

    @property
    def memoryless(self) -> bool:
        return True

    @property
    def knows_loads(self) -> bool:
        return False

    def fault(self, case):
        count = self.gains.shape[0]
        if count != len(case.actuators):
            return (
                f"gains must list one gain for each of {len(case.actuators)} actuators, not {count}"
            )
        if count > len(case.sensors):
            return f"gains has {count} entries, but there are only {len(case.sensors)} sensors"
        return None

    def init(self, model):
        return None

    def step(self, memory, measurement, t):
        reading = measurement.readings[: self.gains.shape[0]]
        # Spelt so that the derivative at zero is finite for every power.
        magnitude = jnp.abs(reading) ** (self.power - 1) if self.power > 1 else 1.0
        return -self.gains * reading * magnitude, memory
