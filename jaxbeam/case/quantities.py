"""Quantities that a point sensor measures, in terms of deflection w(x, t) and twist theta(x, t).

This is their only list: names and units of sensors, outputs of state spaces and of frequency
responses, and histories of records derive from it (rows: `model.sensing.output_rows`).
"""

from typing import NamedTuple

SIDES = ("left", "right")  # of a position
OF_QUANTITY = "unit of quantity"  # unit of the entries of a sensor that are in that of its quantity
# Orders of fields of the beam that are no x-derivatives of the deflection: see `Modes.fields`.
SLOPE, TWIST, TWIST_RATE = -1, -2, -3
NO_TORSION = (
    "the beam does not twist: give beam.torsional_rigidity (G J) and beam.polar_inertia for"
    " twist, torque and eccentric loads"
)


class Quantity(NamedTuple):
    """Unit of a quantity, and its orders of derivation of w by position and by time.

    The derivative is multiplied by -z `at_fibre`, z (m) being the height of a fibre above the
    neutral axis; by the bending stiffness E I if it is a `section_force`, to which active moments
    of patches belong; and divided by the section modulus (m^3) if it is `over_modulus`. A slope
    `of_axis` is w' also where a section that is flexible in shear has another rotation. Those
    `of_twist` are theta, and its x-derivative times the torsional rigidity G J.
    """

    unit: str
    x_derivative: int = 0
    time_derivative: int = 0
    at_fibre: bool = False
    section_force: bool = False
    over_modulus: bool = False
    of_axis: bool = False
    of_twist: bool = False

    @property
    def field(self) -> int:
        """Order of the field of the beam (see `model.modes.Modes.fields`)."""
        if self.of_twist:
            return TWIST_RATE if self.x_derivative else TWIST
        return SLOPE if self.of_axis else self.x_derivative

    @property
    def bends(self) -> bool:
        """Whether it is a curvature, a derivative of one, twist or torque: statically corrected."""
        return (self.x_derivative >= 2 or self.of_twist) and self.time_derivative == 0

    @property
    def jumps(self) -> bool:
        """Whether it jumps under a load: a shear force or torque."""
        return self.x_derivative == 3 or self.field == TWIST_RATE

    @property
    def has_active_moment(self) -> bool:
        """Whether the active moment of a patch over the section is part of it."""
        return self.section_force and self.x_derivative == 2


QUANTITIES = {
    "deflection": Quantity("m"),
    "velocity": Quantity("m/s", time_derivative=1),
    "acceleration": Quantity("m/s^2", time_derivative=2),
    "slope": Quantity("rad", x_derivative=1, of_axis=True),
    "rotation": Quantity("rad", x_derivative=1),
    "curvature": Quantity("1/m", x_derivative=2),
    "strain": Quantity("1", x_derivative=2, at_fibre=True),
    "moment": Quantity("N m", x_derivative=2, section_force=True),
    "shear": Quantity("N", x_derivative=3, section_force=True),
    "stress": Quantity("Pa", x_derivative=2, section_force=True, over_modulus=True),
    "twist": Quantity("rad", of_twist=True),
    "torque": Quantity("N m", x_derivative=1, of_twist=True),
}

# Quantities of the bodies of vehicles and absorbers, and those of the beam in the same units; a
# stroke, relative to the beam, is that of an absorber.
BODY_QUANTITIES = {
    "acceleration": "acceleration",
    "velocity": "velocity",
    "displacement": "deflection",
    "stroke": "deflection",
}


def unit_of(name: str) -> str | None:
    """SI unit of a quantity of the beam or of a body, None for any other name."""
    quantity = QUANTITIES.get(BODY_QUANTITIES.get(name, name))
    return None if quantity is None else quantity.unit


def quantity_of(
    name: str, fibre_distance: object = None, section_modulus: object = None
) -> Quantity:
    """The quantity of a name.

    Raises ValueError for an unknown name, for a quantity at a fibre without the distance (m) of the
    fibre, for a stress without the section modulus (m^3), and for a rate of a curvature, whose sum
    of modes would need the rates of all forces on the beam.
    """
    if name not in QUANTITIES:
        raise ValueError(f"no quantity {name!r}; there are {', '.join(QUANTITIES)}")
    quantity = QUANTITIES[name]
    if quantity.at_fibre and fibre_distance is None:
        raise ValueError(f"{name} needs fibre_distance, the height above the neutral axis in m")
    if quantity.x_derivative >= 2 and quantity.time_derivative:
        raise ValueError(
            f"{name} is a rate of a curvature, which has no static correction: take differences of"
            " the curvature over time"
        )
    if quantity.over_modulus and section_modulus is None:
        raise ValueError(f"{name} needs section_modulus, bending moment over stress in m^3")
    return quantity
