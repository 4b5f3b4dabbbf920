"""Contact of wheels with the beam: held together, or one-sided.

The bilateral contact law lets a wheel pull; a run then warns of it. With unilateral contact a wheel
leaves the surface where it would have to pull, flies, and lands. A wheel with mass is rigid, unless
a spring of contact is given: it then lands by an inelastic impact, after which it moves with the
surface. With the velocities u of the wheels relative to the surface, the masses m of the wheels,
and the mode shapes S of unit modal mass at them, impulses p (N s) change u by (1 / m + S S') p, so
that

    p >= 0,   u + (1 / m + S S') p >= 0,   and for each wheel one of both is zero.

The energy of these velocities falls; the drive that keeps a wheel at its speed does the work
p x' (w_x + r'). A wheel that would rise after an impact by less than the rounding of gaps is held
on the surface, u = 0, or impacts would follow each other ever faster without end. With a spring of
contact, and for wheels that stand on a tyre, there is no impact: forces begin at zero at landing,
or at what a damper of the tyre makes of the speed of approach. The lower end of a tyre in flight
has no mass and relaxes on spring and damper.
"""

import abc
from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import POSITIVE, concrete, number
from jaxbeam.runtime.arrays import Module, Number

ONE_RUN = (
    "contact.kind 'unilateral' is for one run of concrete numbers by jaxbeam.simulate, without"
    " plan, controller, transformation or derivative, as wheels leave and land at times that only"
    " the run tells: run such cases one by one, or leave the contact out, which is then bilateral"
)
HERTZ_POWER = 1.5  # of the compression, in the force of a ball or a crowned wheel


class AbstractContact(ReprWithUnits, Module):
    """Contact of all wheels with the surface: what happens where one would have to pull.

    To add one, write a subclass that declares its `kind`.
    """

    kind: ClassVar[str]

    @property
    @abc.abstractmethod
    def lifts(self) -> bool:
        """Whether wheels leave where they would have to pull."""

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        return None


class BilateralContact(AbstractContact):
    """Bilateral contact: wheels stay on the surface and pull where they must; the default.

    >>> import jaxbeam as jb
    >>> print(jb.BilateralContact().lifts)
    False
    """

    kind: ClassVar[str] = "bilateral"

    @property
    def lifts(self):
        return False


class UnilateralContact(AbstractContact):
    """Unilateral contact: wheels leave the surface where they would have to pull, and land.

    Wheels with mass are rigid, and impacts inelastic, unless one of the springs is given. That
    spring is between each wheel with mass and the surface, compressed by the static load as a run
    starts. Tyres are springs of their own, and given forces stay as they are. For runs of
    `simulate` without controller.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(1.0, 1.0, 1.0, damping_ratio=0.02, modes=10),
    ...     sensors=[jb.Sensor(0.5)],
    ...     loads=[jb.MovingMass(mass=0.5, speed=1.5707963)],
    ...     contact=jb.UnilateralContact(),
    ...     run=jb.Run(0.7, gravity=2.0),
    ... )
    >>> flights = jb.simulate(case).flights
    >>> print(f"{flights.lift_position[0]:.4f} m")
    0.9372 m
    """

    kind: ClassVar[str] = "unilateral"

    stiffness: Float[Number, ""] | None = number(
        "N/m", "spring between wheel and surface, if the contact is no rigid one", POSITIVE,
        default=None,
    )  # fmt: skip
    hertz_stiffness: Float[Number, ""] | None = number(
        "N/m^1.5", "spring of Hertz: its force is this times compression^1.5", POSITIVE,
        default=None,
    )  # fmt: skip

    @property
    def lifts(self):
        return True

    def validate(self, address):
        if self.stiffness is not None and self.hertz_stiffness is not None:
            return f"{address} has both stiffness and hertz_stiffness; leave one out"
        return None

    def spring(self) -> tuple[float, float] | None:
        """Factor and power of the force of compression; None where wheels are rigid."""
        if self.hertz_stiffness is not None:
            return float(concrete(self.hertz_stiffness)), HERTZ_POWER
        return None if self.stiffness is None else (float(concrete(self.stiffness)), 1.0)
