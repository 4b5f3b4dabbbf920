"""Actuators: the interface, and those at a point or along a patch.

Each is one linear attachment to the beam: forces, shakers with a suspension, springs and dampers,
and piezoelectric macro-fibre patches bonded to it, in 33 mode.
"""

import abc
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.actuators.hysteresis import Creep, Hysteresis
from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import (
    INCREASING,
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    concrete,
    is_concrete,
    number,
    part,
    validate_direct_or_derived,
)
from jaxbeam.runtime.arrays import Array, Module, Number, xp


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

    @property
    def accepts_commands(self) -> bool:
        """Whether it accepts commands; a passive device does not."""
        return self.command_unit != "1"

    @property
    def has_limited_loop(self) -> bool:
        """Whether it is a shaker whose voltage has limits within an inner loop."""
        return False

    def command_limits(self) -> Float[Array, "2"] | None:
        """Smallest and largest command, in the unit of the command; None if unlimited."""
        return self.limits

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        return None

    def command_rate_limit(self) -> Float[Array, ""] | None:
        """Largest rate of change of the command, per second; None if unlimited."""
        return None


def limited_loops(actuators: Sequence[AbstractActuator]) -> tuple[int, ...]:
    """Indices of the shakers whose voltage has limits within an inner loop."""
    return tuple(i for i, actuator in enumerate(actuators) if actuator.has_limited_loop)


class PointForce(AbstractActuator):
    """Ideal point force: a command of 1 N pushes the beam up with 1 N.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.Feedback(gains=[2e3], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.900 mm
    """

    kind: ClassVar[str] = "point"

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    limits: Float[Number, "2"] | None = number(
        "N", "smallest and largest command", INCREASING, default=None
    )

    def displacement_map(self):
        return ((self.position, 0, 1.0),)

    def attachment(self) -> Attachment:
        no_states, zero = xp.zeros(0), xp.zeros(())
        return Attachment(
            xp.zeros((0, 0)), no_states, no_states, no_states, xp.ones(()), zero, zero
        )


class Shaker(AbstractActuator):
    """Electrodynamic shaker: voltage to force through a first-order lag, with its suspension.

    z' = bandwidth (u - z), force = force_per_volt z - stiffness w - damping w': eqs (2.35) and
    (2.36) of the thesis with alpha = beta = bandwidth. A positive voltage lifts the beam. Without a
    command only the spring and damper of its suspension act.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.Shaker(0.3, stiffness=200.0, force_per_volt=5.0, limits=(-4.0, 4.0))],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.Feedback(gains=[1e3], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.606 mm
    """

    kind: ClassVar[str] = "shaker"

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    stiffness: Float[Number, ""] = number("N/m", "suspension stiffness", NOT_NEGATIVE, default=0.0)
    damping: Float[Number, ""] = number("N s/m", "suspension damping", NOT_NEGATIVE, default=0.0)
    force_per_volt: Float[Number, ""] = number("N/V", "steady force per volt", default=4.6)
    bandwidth: Float[Number, ""] = number(
        "1/s", "bandwidth of the first-order lag", POSITIVE, default=1e4
    )
    limits: Float[Number, "2"] | None = number(
        "V", "smallest and largest voltage", INCREASING, default=None
    )

    def displacement_map(self):
        return ((self.position, 0, 1.0),)

    def attachment(self) -> Attachment:
        return Attachment(
            state_matrix=-self.bandwidth[None, None],
            input_matrix=self.bandwidth[None],
            velocity_matrix=xp.zeros(1),
            output_matrix=self.force_per_volt[None],
            feedthrough=xp.zeros(()),
            stiffness=self.stiffness,
            damping=self.damping,
        )


class SpringDamper(AbstractActuator):
    """Spring and damper from the beam to ground; it takes no command.

    Unlike an elastic support it does not enter the modes: it couples the modes of the beam without
    it, as in eq. (2.17) of the thesis, so results converge with the number of modes.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.SpringDamper(0.3, stiffness=2e3, damping=5.0)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=2.0)],
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.851 mm
    """

    kind: ClassVar[str] = "spring"

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    stiffness: Float[Number, ""] = number("N/m", "spring", NOT_NEGATIVE, default=0.0)
    damping: Float[Number, ""] = number("N s/m", "damper", NOT_NEGATIVE, default=0.0)
    limits: Float[Number, "2"] | None = number(
        "1", "without effect: it takes no command", INCREASING, default=None
    )

    def displacement_map(self):
        return ((self.position, 0, 1.0),)

    def attachment(self) -> Attachment:
        no_states, zero = xp.zeros(0), xp.zeros(())
        square = xp.zeros((0, 0))
        return Attachment(
            square, no_states, no_states, no_states, zero, self.stiffness, self.damping
        )


# Fields from which the moment per volt is derived where it is not given.
MOMENT_SOURCES = (
    "d33",
    "modulus",
    "electrode_spacing",
    "beam_height",
    "patch_height",
    "patch_width",
)


class Patch(AbstractActuator):
    """Piezoelectric patch from `start` to `end`: a pair of opposite moments at its edges.

    The moment is `moment_per_volt` x `correction` x patch voltage, and the patch voltage is
    `amplifier_gain` x command, eqs (2.43) and (2.46) of the thesis. A positive voltage lifts the
    beam. Give either `moment_per_volt` or all that it follows from (see `moment_constant`).
    `added_mass` and `added_rigidity` act over its length and enter the modes.

    Commands stay within `limits` and within the voltages `depolarisation`, beyond which the patch
    loses its polarisation; `rate_limit` is that of the amplifier. Commands act through the
    `hysteresis` of the patch and then its `creep`, if it has them; the inverses of `compensation`
    (identified from a log by `tuning.fit.hysteresis`) and `creep_compensation` make it act as a
    linear one.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[
    ...         jb.Patch(
    ...             0.25, 0.35, moment_per_volt=8e-4, amplifier_gain=200.0, limits=(-2.5, 7.5)
    ...         )
    ...     ],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.Feedback(gains=[2e3], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.154 mm
    """

    kind: ClassVar[str] = "patch"

    start: Float[Number, ""] = number("m", "left edge", ON_BEAM)
    end: Float[Number, ""] = number("m", "right edge", ON_BEAM)
    moment_per_volt: Float[Number, ""] | None = number(
        "N m/V", "moment per volt at the patch", default=None
    )
    correction: Float[Number, ""] = number(
        "1", "fraction of the moment that reaches the beam", default=1.0
    )
    amplifier_gain: Float[Number, ""] = number(
        "1", "patch volts per volt of command", POSITIVE, default=1.0
    )
    limits: Float[Number, "2"] | None = number(
        "V", "smallest and largest command, at the input of the amplifier", INCREASING, default=None
    )
    added_mass: Float[Number, ""] | None = number(
        "kg/m", "mass per length added", NOT_NEGATIVE, default=None
    )
    added_rigidity: Float[Number, ""] | None = number(
        "N m^2", "bending stiffness added", NOT_NEGATIVE, default=None
    )
    d33: Float[Number, ""] | None = number("m/V", "piezoelectric constant", default=None)
    modulus: Float[Number, ""] | None = number(
        "Pa", "Young's modulus of the patch", POSITIVE, default=None
    )
    electrode_spacing: Float[Number, ""] | None = number(
        "m", "distance between electrodes", POSITIVE, default=None
    )
    beam_height: Float[Number, ""] | None = number(
        "m", "height of the beam under the patch", POSITIVE, default=None
    )
    patch_height: Float[Number, ""] | None = number(
        "m", "height of the patch", POSITIVE, default=None
    )
    patch_width: Float[Number, ""] | None = number(
        "m", "width of the patch", POSITIVE, default=None
    )
    depolarisation: Float[Number, "2"] = number(
        "V", "smallest and largest voltage at the patch", INCREASING, default=(-500.0, 1500.0)
    )
    rate_limit: Float[Number, ""] | None = number(
        "V/s", "largest rate of change of the command", POSITIVE, default=None
    )
    hysteresis: Hysteresis | None = part("hysteresis of the patch", Hysteresis)
    compensation: Hysteresis | None = part(
        "hysteresis whose inverse the controller applies to its commands", Hysteresis
    )
    creep: Creep | None = part("creep of the patch, behind its hysteresis", Creep)
    creep_compensation: Creep | None = part(
        "creep whose inverse the controller applies to its commands", Creep
    )

    @property
    def moment_constant(self) -> Float[Array, ""]:
        """Moment per volt at the patch (N m/V), given or C_0 of eq. (2.43) of the thesis.

        C_0 = d33 E_p / L_e x h / 2 x h_p b_p for a thin patch, h_p much smaller than h.
        """
        if self.moment_per_volt is not None:
            return self.moment_per_volt
        stress = self.d33 * self.modulus / self.electrode_spacing
        return stress * self.beam_height / 2 * self.patch_height * self.patch_width

    def displacement_map(self):
        return ((self.start, 1, 1.0), (self.end, 1, -1.0))

    def attachment(self) -> Attachment:
        no_states, zero = xp.zeros(0), xp.zeros(())
        moment = self.moment_constant * self.correction * self.amplifier_gain
        return Attachment(xp.zeros((0, 0)), no_states, no_states, no_states, moment, zero, zero)

    def section_stiffening(self) -> SectionStiffening | None:
        if self.added_mass is None and self.added_rigidity is None:
            return None
        mass = xp.zeros(()) if self.added_mass is None else self.added_mass
        rigidity = xp.zeros(()) if self.added_rigidity is None else self.added_rigidity
        return SectionStiffening(self.start, self.end, rigidity, mass)

    def command_limits(self) -> Float[Array, "2"]:
        depolarisation_limits = self.depolarisation / self.amplifier_gain
        if self.limits is None:
            return depolarisation_limits
        lowest = xp.maximum(depolarisation_limits[0], self.limits[0])
        highest = xp.minimum(depolarisation_limits[1], self.limits[1])
        return xp.stack([lowest, highest])

    def command_rate_limit(self) -> Float[Array, ""] | None:
        return self.rate_limit

    def validate(self, address: str) -> str | None:
        if is_concrete(self.start) and is_concrete(self.end):
            start, end = concrete(self.start), concrete(self.end)
            if start >= end:
                return (
                    f"{address}.end must lie to the right of {address}.start;"
                    f" {end:g} m is not beyond {start:g} m"
                )
        limits = self.command_limits()
        if is_concrete(limits) and concrete(limits)[0] >= concrete(limits)[1]:
            low, high = concrete(self.depolarisation / self.amplifier_gain)
            return (
                f"{address}.limits leave no command that the patch takes: its depolarisation limits"
                f" over its amplifier_gain allow {low:g} to {high:g} V"
            )
        for name in ("hysteresis", "compensation", "creep", "creep_compensation"):
            operator = getattr(self, name)
            error = None if operator is None else operator.validate()
            if error is not None:
                return f"{address}.{name}.{error}"
        return validate_direct_or_derived(address, self, "moment_per_volt", MOMENT_SOURCES)
