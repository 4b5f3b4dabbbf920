"""Piezoelectric macro-fibre patch bonded to the beam, 33 mode."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.actuators.base import AbstractActuator, Attachment, Bonded
from jaxbeam.fields import INCREASING, NOT_NEGATIVE, ON_BEAM, number


class Patch(AbstractActuator):
    """Piezoelectric patch from `start` to `end`: a pair of opposite moments at its edges.

    The moment is `moment_per_volt` x `correction` x patch voltage, and the patch voltage is
    `amplifier_gain` x command, eqs (2.43) and (2.46) of the thesis. Positive voltage lifts the
    beam. `added_mass` and `added_rigidity` act over its length and shape the modes.
    """

    start: Float[Array, ""] = number("m", "left edge", ON_BEAM)
    end: Float[Array, ""] = number("m", "right edge", ON_BEAM)
    moment_per_volt: Float[Array, ""] = number("N m/V", "moment per volt at the patch")
    correction: Float[Array, ""] = number(
        "1", "share of the moment that reaches the beam", default=1.0
    )
    amplifier_gain: Float[Array, ""] = number("1", "patch volts per volt of command", default=1.0)
    limits: Float[Array, "2"] | None = number(
        "V", "smallest and largest command, at the amplifier's input", INCREASING, default=None
    )
    added_mass: Float[Array, ""] | None = number(
        "kg/m", "mass per length added", NOT_NEGATIVE, default=None
    )
    added_rigidity: Float[Array, ""] | None = number(
        "N m^2", "bending stiffness added", NOT_NEGATIVE, default=None
    )

    def stroke(self):
        return ((self.start, 1, 1.0), (self.end, 1, -1.0))

    def attachment(self) -> Attachment:
        none, zero = jnp.zeros(0), jnp.zeros(())
        moment = self.moment_per_volt * self.correction * self.amplifier_gain
        return Attachment(jnp.zeros((0, 0)), none, none, none, moment, zero, zero)

    def bonded(self) -> Bonded | None:
        if self.added_mass is None and self.added_rigidity is None:
            return None
        mass = jnp.zeros(()) if self.added_mass is None else self.added_mass
        rigidity = jnp.zeros(()) if self.added_rigidity is None else self.added_rigidity
        return Bonded(self.start, self.end, rigidity, mass)
