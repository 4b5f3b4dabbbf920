"""What is measured, and where."""

import equinox as eqx
from jaxtyping import Array, Float

from jaxbeam.fields import ON_BEAM, choice, number

QUANTITIES = {
    "deflection": "m",
    "velocity": "m/s",
    "acceleration": "m/s^2",
    "slope": "rad",
    "strain": "1",
}


class Sensor(eqx.Module):
    """A point sensor on the beam.

    `strain` is the bending strain at the fibre `fibre_distance` above the neutral axis,
    -z d2w/dx2; deflection is positive upwards. `offset` is added to the reading.
    """

    position: Float[Array, ""] = number("m", "distance from the left end", ON_BEAM)
    quantity: str = choice("what is measured", *QUANTITIES, default="deflection")
    offset: Float[Array, ""] = number("unit of quantity", "constant added", default=0.0)
    fibre_distance: Float[Array, ""] | None = number(
        "m", "height of the strain gauge above the neutral axis", default=None
    )
