"""Feedback of what the sensors read, through a power law or an odd polynomial."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import count, number


def pairing_error(gains: Float[Array, " actuator"], case) -> str | None:
    """What is wrong with gains of loops from each sensor to the actuator of its number; or None."""
    loops, actuators = gains.shape[0], len(case.actuators)
    if loops != actuators:
        return f"gains must list one gain for each of {actuators} actuators, not {loops}"
    if loops > len(case.sensors):
        return f"gains has {loops} entries, but there are only {len(case.sensors)} sensors"
    return None


class Feedback(AbstractController):
    """Each actuator answers the reading y of its own sensor: u = -sum_k g_k y |y|^(p_k - 1).

    The first actuator listens to the first sensor, the second to the second, and so on. The first
    term has `gains` and `power`: 1 is linear feedback, 3 the cubic law of chapter 6 of the thesis
    (corrected sign: eq. 2.46 with u = -k w). Row after row, `higher_gains` are those of the powers
    power + 2, power + 4, ...: linear and cubic feedback mixed has power 1 and one row, and more
    rows make any odd polynomial.
    """

    gains: Float[Array, " actuator"] = number(
        "command per reading^power", "one gain for each actuator"
    )
    power: int = count("power of the reading", default=1)
    higher_gains: Float[Array, "term actuator"] | None = number(
        "command per reading^(power + 2, power + 4, ...)",
        "row of gains for each further odd power",
        default=None,
    )

    @property
    def stateless(self) -> bool:
        return True

    @property
    def design_depends_on_loads(self) -> bool:
        return False

    def validate(self, case):
        actuators = len(case.actuators)
        error = pairing_error(self.gains, case)
        if error is not None:
            return error
        if self.higher_gains is not None and self.higher_gains.shape[1] != actuators:
            return (
                f"higher_gains must have in each row a gain for each of {actuators} actuators,"
                f" not {self.higher_gains.shape[1]}"
            )
        return None

    def init(self, plant):
        return None

    def step(self, memory, measurement, t):
        reading = measurement.readings[: self.gains.shape[0]]
        rows = [self.gains, *([] if self.higher_gains is None else self.higher_gains)]
        gain = rows[-1]
        for row in rows[-2::-1]:  # Horner's scheme in y^2
            gain = row + gain * reading**2
        # Spelt so that the derivative at zero is finite for every power.
        magnitude = jnp.abs(reading) ** (self.power - 1) if self.power > 1 else 1.0
        return -gain * reading * magnitude, memory
