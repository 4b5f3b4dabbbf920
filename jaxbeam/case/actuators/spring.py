"""A passive spring and damper to ground, acting on the modes as they are."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.actuators.base import AbstractActuator, Attachment
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, ON_BEAM, number


class SpringDamper(AbstractActuator):
    """A spring and damper from the beam to ground; it takes no command.

    Unlike a support it does not shape the modes: it couples those of the beam without it, as in
    eq. (2.17) of the thesis. The result depends on the number of modes kept.
    """

    position: Float[Array, ""] = number("m", "distance from the left end", ON_BEAM)
    stiffness: Float[Array, ""] = number("N/m", "spring", NOT_NEGATIVE, default=0.0)
    damping: Float[Array, ""] = number("N s/m", "damper", NOT_NEGATIVE, default=0.0)
    limits: Float[Array, "2"] | None = number(
        "1", "unused: takes no command", INCREASING, default=None
    )

    def displacement_map(self):
        return ((self.position, 0, 1.0),)

    def attachment(self) -> Attachment:
        no_states, zero = jnp.zeros(0), jnp.zeros(())
        square = jnp.zeros((0, 0))
        return Attachment(
            square, no_states, no_states, no_states, zero, self.stiffness, self.damping
        )
