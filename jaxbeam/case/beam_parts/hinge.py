"""Hinge inside a beam."""

from jaxtyping import Float

from jaxbeam.case.display.parts import ReprWithUnits
from jaxbeam.case.fields import NOT_NEGATIVE, ON_BEAM, number
from jaxbeam.runtime.arrays import Array


class Hinge(ReprWithUnits):
    """Hinge between the ends of a beam: no bending moment, or that of a rotational spring.

    The deflection is continuous, the rotation jumps. A moment M = k (phi_right - phi_left) is that
    of a semi-rigid joint of `rotational_stiffness` k.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(10.0, 2e7, 400.0, ends="clamped-pinned", hinges=[jb.Hinge(6.0)])
    >>> print(jb.modes(jb.Case(beam)).frequencies.round(2)[:2])
    [ 2.52 16.91]
    """

    position: Float[Array, ""] = number("m", "distance from the left end", ON_BEAM)
    rotational_stiffness: Float[Array, ""] = number(
        "N m/rad", "spring between both sides", NOT_NEGATIVE, default=0.0
    )
