"""Segment of a stepped or tapered beam."""

from jaxtyping import Float

from jaxbeam.case.display.parts import ReprWithUnits
from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, number
from jaxbeam.runtime.arrays import Array


class Segment(ReprWithUnits):
    """Length of a beam over which stiffness and mass are constant or polynomials.

    Each property is one number, or the coefficients c_0, c_1, ... of

        c_0 + c_1 s + c_2 s^2 + ...,    s = 0 at the left end of the segment, 1 at its right end,

    so that [1.0, -0.5] falls from 1.0 to 0.5. A property that is left out is that of the beam.
    `width` and `height` (in the bending direction) are those of a rectangular section of the
    beam's `youngs_modulus` and `density`. The last segment may leave out its `length`: it ends
    where the beam does.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(
    ...     10.0, segments=[jb.Segment(6.0, 2e7, 400.0), jb.Segment(4.0, 1e7, 300.0)]
    ... )
    >>> print(jb.modes(jb.Case(beam)).frequencies.round(2)[:2])
    [ 3.22 12.83]
    """

    length: Float[Array, ""] | None = number("m", "length", POSITIVE, default=None)
    flexural_rigidity: Float[Array, " *power"] | None = number(
        "N m^2", "bending stiffness E I", default=None
    )
    mass_per_length: Float[Array, " *power"] | None = number(
        "kg/m", "mass per length", default=None
    )
    width: Float[Array, " *power"] | None = number("m", "section width", default=None)
    height: Float[Array, " *power"] | None = number("m", "section height", default=None)
    shear_stiffness: Float[Array, " *power"] | None = number(
        "N", "shear stiffness kappa G A", default=None
    )
    rotary_inertia: Float[Array, " *power"] | None = number(
        "kg m", "mass moment of inertia per length, rho I", default=None
    )
    foundation_stiffness: Float[Array, " *power"] | None = number(
        "N/m^2", "elastic foundation, force per length and deflection", default=None
    )
    loss_factor: Float[Array, ""] | None = number(
        "1", "loss factor of its material", NOT_NEGATIVE, default=None
    )
