"""Quantities that a point sensor measures, in terms of the deflection w(x, t).

This is their only list: names and units of sensors, outputs of state spaces and of frequency
responses, and histories of records derive from it (rows of the outputs: `model.output_rows`).
"""

from typing import NamedTuple


class Quantity(NamedTuple):
    """Unit of a quantity, and its orders of derivation of w by position and by time.

    With `at_fibre` the derivative is multiplied by -z, z (m) being the height of a fibre above
    the neutral axis.
    """

    unit: str
    x_derivative: int = 0
    time_derivative: int = 0
    at_fibre: bool = False


QUANTITIES = {
    "deflection": Quantity("m"),
    "velocity": Quantity("m/s", time_derivative=1),
    "acceleration": Quantity("m/s^2", time_derivative=2),
    "slope": Quantity("rad", x_derivative=1),
    "strain": Quantity("1", x_derivative=2, at_fibre=True),
}


def quantity_of(name: str, fibre_distance: object = None) -> Quantity:
    """The quantity of a name.

    Raises ValueError for an unknown name, and for a quantity at a fibre without the distance (m)
    of the fibre.
    """
    if name not in QUANTITIES:
        raise ValueError(f"no quantity {name!r}; there are {', '.join(QUANTITIES)}")
    quantity = QUANTITIES[name]
    if quantity.at_fibre and fibre_distance is None:
        raise ValueError(f"{name} needs fibre_distance, the height above the neutral axis in m")
    return quantity
