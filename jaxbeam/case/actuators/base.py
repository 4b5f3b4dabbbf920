"""Interface of actuators: one linear attachment to the beam."""

import abc
from typing import ClassVar

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.actuators.hysteresis import Creep, Hysteresis
from jaxbeam.case.display import ReprWithUnits
from jaxbeam.runtime.arrays import Array, Module, xp


class Attachment(Module):
    """Linear device that acts on the beam along one generalised displacement s.

    s is the displacement at its port, a deflection or a difference of slopes of the beam (see
    `displacement_map`), u the command, z the states of the device and r its generalised force on
    the beam, so that r s' is the power into the beam:

        z' = A z + B u + E s',      r = C z + D u - mass s'' - damping s' - stiffness s

    `mass` is None for a device without inertia, which then does not couple the modes.
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
        """Generalised force per unit of a steady command, with the port at rest."""
        steady_states = xp.linalg.solve(self.state_matrix, self.input_matrix)
        return self.feedthrough - self.output_matrix @ steady_states


class SectionStiffening(Module):
    """Bending stiffness (N m^2) and mass per length (kg/m) added between two positions (m)."""

    start: Float[Array, ""]
    end: Float[Array, ""]
    bending_stiffness: Float[Array, ""]
    mass_per_length: Float[Array, ""]


class AbstractActuator(ReprWithUnits, Module):
    """Device that turns a command, in V, A or N, into a force or a couple on the beam.

    To add one, write a file in `jaxbeam.case.actuators` with a subclass that declares its `kind`.
    """

    kind: ClassVar[str]
    limits: eqx.AbstractVar[Float[Array, "2"] | None]

    @property
    def hysteresis(self) -> Hysteresis | None:
        """Hysteresis from commands to the commands that act; None if there is none."""
        return None

    @property
    def compensation(self) -> Hysteresis | None:
        """Hysteresis whose inverse is applied to the commands of a controller; None without one."""
        return None

    @property
    def creep(self) -> Creep | None:
        """Creep of the commands that act, behind the hysteresis; None if there is none."""
        return None

    @property
    def creep_compensation(self) -> Creep | None:
        """Creep whose inverse is applied to the commands of a controller; None without one."""
        return None

    @abc.abstractmethod
    def displacement_map(self) -> tuple[tuple[Float[Array, ""], int, float], ...]:
        """Displacement at the port, a sum of factor * d^n w / dx^n (x): terms (x in m, n, factor).

        A point force acts on the deflection at its position: ((x, 0, 1.0),); a patch on the
        difference of the slopes at its ends: ((x1, 1, 1.0), (x2, 1, -1.0)).
        """

    @abc.abstractmethod
    def attachment(self) -> Attachment:
        """Linear model from command (V or N) and displacement to generalised force."""

    def section_stiffening(self) -> SectionStiffening | None:
        """Section of a bonded actuator, which enters the modes of the beam; None if not bonded."""
        return None

    @property
    def command_unit(self) -> str:
        """SI unit of the command, V or N; "1" for a passive device, which takes none."""
        return type(self).__dataclass_fields__["limits"].metadata["unit"]

    def command_limits(self) -> Float[Array, "2"] | None:
        """Smallest and largest command, in the unit of the command; None if unlimited."""
        return self.limits

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        return None

    def command_rate_limit(self) -> Float[Array, ""] | None:
        """Largest rate of change of the command, per second; None if unlimited."""
        return None
