"""What every actuator says about itself: one linear attachment to the beam."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class Attachment(eqx.Module):
    """A linear device attached to the beam through one generalised coordinate.

    With s the stroke (the beam's deflection or difference of slopes where the device acts,
    s = shape . q) and r the generalised force it exerts on the beam along s,

        z' = A z + B u + E s',      r = C z + D u - mass s'' - damping s' - stiffness s

    so that power flowing into the beam is r s'. States z are the device's own; `mass` is None
    where the device has none, which saves the modes from being coupled by it.
    """

    state_matrix: Float[Array, "state state"]
    input_matrix: Float[Array, " state"]
    velocity_matrix: Float[Array, " state"]
    output_matrix: Float[Array, " state"]
    feedthrough: Float[Array, ""]
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    mass: Float[Array, ""] | None = None

    @property
    def static_gain(self) -> Float[Array, ""]:
        """Generalised force per unit of a steady command, the stroke at rest."""
        steady_states = jnp.linalg.solve(self.state_matrix, self.input_matrix)
        return self.feedthrough - self.output_matrix @ steady_states


class SectionStiffening(eqx.Module):
    """What a bonded actuator adds to the section of the beam between two positions (m)."""

    start: Float[Array, ""]
    end: Float[Array, ""]
    bending_stiffness: Float[Array, ""]
    mass_per_length: Float[Array, ""]


class AbstractActuator(eqx.Module):
    """Interface of all actuators.

    To add one, write a file with a subclass and name it in `jaxbeam.case.actuators.KINDS`.
    """

    limits: eqx.AbstractVar[Float[Array, "2"] | None]

    @abc.abstractmethod
    def displacement_map(self) -> tuple[tuple[Float[Array, ""], int, float], ...]:
        """Where it acts: terms (position in m, derivative of the deflection, factor).

        A point force acts on the deflection at its position: ((x, 0, 1.0),); a patch on the
        difference of slopes over its length: ((x1, 1, 1.0), (x2, 1, -1.0)).
        """

    @abc.abstractmethod
    def attachment(self) -> Attachment:
        """Its linear model, from command (V or N) to generalised force."""

    def section_stiffening(self) -> SectionStiffening | None:
        """Bending stiffness (N m^2) and mass per length (kg/m) added; they shape the modes."""
        return None

    @property
    def command_unit(self) -> str:
        """SI unit of a command, V or N; "1" for a passive device, which takes none."""
        return type(self).__dataclass_fields__["limits"].metadata["unit"]

    def command_limits(self) -> Float[Array, "2"] | None:
        """Smallest and largest command it takes, in the unit of a command; None if any."""
        return self.limits

    def validate(self, address: str) -> str | None:
        """What does not go together in it, as a sentence naming its address, or None."""
        return None

    def command_rate_limit(self) -> Float[Array, ""] | None:
        """Fastest change of the command it can follow, per second; None if any."""
        return None
