"""What is measured, and where."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, ON_BEAM, POSITIVE, choice, number, part
from jaxbeam.case.filters import Filter

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
    -z d2w/dx2; deflection is positive upwards. `offset` is added to the reading; noise, range,
    resolution and a filter follow, and whatever is left out is ideal (see `sensing`).
    """

    position: Float[Array, ""] = number("m", "distance from the left end", ON_BEAM)
    quantity: str = choice("what is measured", *QUANTITIES, default="deflection")
    offset: Float[Array, ""] = number("unit of quantity", "constant added", default=0.0)
    fibre_distance: Float[Array, ""] | None = number(
        "m", "height of the strain gauge above the neutral axis", default=None
    )
    noise: Float[Array, ""] | None = number(
        "unit of quantity", "standard deviation of white noise", NOT_NEGATIVE, default=None
    )
    range: Float[Array, "2"] | None = number(
        "unit of quantity", "smallest and largest reading", INCREASING, default=None
    )
    resolution: Float[Array, ""] | None = number(
        "unit of quantity", "step between readings", POSITIVE, default=None
    )
    filter: Filter | None = part("filter of the signal or of its samples", Filter)
    sampling_period: Float[Array, ""] | None = number(
        "s", "time between readings; that of controller or run if left out", POSITIVE, default=None
    )
    delay: Float[Array, ""] | None = number(
        "s", "age of the deflection that is read", NOT_NEGATIVE, default=None
    )

    @property
    def noise_variance(self) -> Float[Array, ""]:
        """Variance of the noise of one reading, in the square of its unit; what filters call R."""
        return jnp.zeros(()) if self.noise is None else self.noise**2

    def validate(self, address: str) -> str | None:
        """What does not go together in it, as a sentence, or None."""
        if self.quantity == "strain" and self.fibre_distance is None:
            return (
                f"{address}.fibre_distance is missing: strain needs the height of the gauge above"
                " the neutral axis in m"
            )
        if self.quantity != "strain" and self.fibre_distance is not None:
            return (
                f"{address}.fibre_distance would have no effect on a sensor of {self.quantity};"
                " leave it out, or set quantity to 'strain'"
            )
        return None
