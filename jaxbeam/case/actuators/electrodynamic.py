"""Electrodynamic shaker with the dynamics of its coil, from voltage through current to force."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.actuators.base import AbstractActuator, Attachment
from jaxbeam.case.actuators.inner_loops import AbstractInnerLoop, Coil, LoopPort, coil_alone
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, ON_BEAM, POSITIVE, number, part
from jaxbeam.runtime.arrays import Array


class Electrodynamic(AbstractActuator):
    """Electrodynamic shaker with coil, moving mass and suspension, fixed to the beam at `position`.

    L I' = u - R I - K_v w',   force = K_f I - m w'' - c w' - k w: eqs (2.26) to (2.34) of the
    thesis in the time domain. Its state is the current I. A positive voltage lifts the beam. A
    command of zero shorts the coil; its back-EMF then damps the beam.

    With an `inner_loop` the amplifier sets the voltage, and the command is a current in A
    (`CurrentLoop`) or a force in N (`ForceLoop`), bounded by the `limits` of the loop. Where the
    amplifier runs out of voltage is not modelled: `limits` of the voltage are refused with a loop;
    the voltage of a run is in `jb.coil_history`, that per command in `jaxbeam frf`.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[
    ...         jb.Electrodynamic(0.3, resistance=3.0, inductance=1e-3, force_constant=8.0)
    ...     ],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.Feedback(gains=[1e3], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.769 mm
    """

    kind: ClassVar[str] = "electrodynamic"

    position: Float[Array, ""] = number("m", "distance from the left end", ON_BEAM)
    resistance: Float[Array, ""] = number("ohm", "coil resistance R", POSITIVE)
    inductance: Float[Array, ""] = number("H", "coil inductance L", POSITIVE)
    force_constant: Float[Array, ""] = number("N/A", "coil force per current K_f")
    back_emf: Float[Array, ""] | None = number(
        "V s/m", "back-EMF constant K_v; K_f if left out", default=None
    )
    mass: Float[Array, ""] = number("kg", "moving mass", NOT_NEGATIVE, default=0.0)
    stiffness: Float[Array, ""] = number("N/m", "suspension stiffness", NOT_NEGATIVE, default=0.0)
    damping: Float[Array, ""] = number("N s/m", "suspension damping", NOT_NEGATIVE, default=0.0)
    limits: Float[Array, "2"] | None = number(
        "V", "smallest and largest voltage", INCREASING, default=None
    )
    inner_loop: AbstractInnerLoop | None = part(
        "loop of the amplifier, by which commands are currents or forces", AbstractInnerLoop
    )

    def displacement_map(self):
        return ((self.position, 0, 1.0),)

    def attachment(self) -> Attachment:
        return self.coil_port().attachment

    def coil_port(self) -> LoopPort:
        """Attachment of the coil, with the current in it and the voltage across it as signals."""
        coil = Coil(
            self.resistance,
            self.inductance,
            self.force_constant,
            self.force_constant if self.back_emf is None else self.back_emf,
            self.mass,
            self.damping,
            self.stiffness,
        )
        return coil_alone(coil) if self.inner_loop is None else self.inner_loop.port(coil)

    @property
    def command_unit(self) -> str:
        return "V" if self.inner_loop is None else self.inner_loop.command_unit

    def command_limits(self) -> Float[Array, "2"] | None:
        return self.limits if self.inner_loop is None else self.inner_loop.limits

    def validate(self, address: str) -> str | None:
        if self.inner_loop is None:
            return None
        if self.limits is not None:
            return (
                f"{address}.limits bound the voltage, which {address}.inner_loop sets beyond them:"
                f" give {address}.inner_loop.limits, in {self.inner_loop.command_unit}, or leave"
                " the loop out"
            )
        error = self.inner_loop.validate()
        return None if error is None else f"{address}.inner_loop.{error}"
