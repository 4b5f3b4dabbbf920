"""Point sensors on the beam."""

from collections.abc import Iterator, Sequence

from jaxtyping import Float

from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import (
    INCREASING,
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    PROBABILITY,
    choice,
    concrete,
    is_concrete,
    number,
    part,
)
from jaxbeam.case.filters import Filter
from jaxbeam.case.quantities import OF_QUANTITY, QUANTITIES, SIDES
from jaxbeam.case.reading.units import in_si
from jaxbeam.runtime.arrays import Array, Number, xp
from jaxbeam.runtime.module import Module


class Sensor(ReprWithUnits, Module):
    """Point sensor of a quantity at a position on the beam; deflections are positive upwards.

    `strain` is the bending strain -z d2w/dx2 of the fibre at z = `fibre_distance` above the neutral
    axis, `moment` the bending moment, positive where the beam sags, `shear` its x-derivative, and
    `stress` the moment over the `section_modulus`. What jumps at the position, as a shear force at
    a support, is read on one `side` of it, by default the right one. Deflections and their rates at
    an `eccentricity` e are w + e theta on a beam that twists. `name` is the label in results.
    `offset` and noise are added to the quantity; the reading is limited to the range and rounded to
    the resolution (see `jaxbeam.model.sensing.sensor_signals`). With the probability `dropout` a
    reading is lost: the last one stays, and a controller knows that it is missing. The others are
    up to `jitter` older than `delay`, equally distributed. Both are drawn by the seed of the run.
    What is left out is ideal.

    >>> import jaxbeam as jb
    >>> sensor = jb.Sensor(0.3, quantity="strain", fibre_distance=0.0025, name="midspan")
    >>> print(sensor.name, sensor.unit)
    midspan 1
    """

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    quantity: str = choice("measured quantity", *QUANTITIES, default="deflection")
    offset: Float[Number, ""] = number(OF_QUANTITY, "constant added", default=0.0)
    fibre_distance: Float[Number, ""] | None = number(
        "m", "height of the strain gauge above the neutral axis", default=None
    )
    noise: Float[Number, ""] | None = number(
        OF_QUANTITY, "standard deviation of white noise", NOT_NEGATIVE, default=None
    )
    range: Float[Number, "2"] | None = number(
        OF_QUANTITY, "smallest and largest reading", INCREASING, default=None
    )
    resolution: Float[Number, ""] | None = number(
        OF_QUANTITY, "step between readings", POSITIVE, default=None
    )
    filter: Filter | None = part("filter of the signal or of its samples", Filter)
    sampling_period: Float[Number, ""] | None = number(
        "s", "time between readings; that of controller or run if left out", POSITIVE, default=None
    )
    delay: Float[Number, ""] | None = number(
        "s", "from deflection to reading", NOT_NEGATIVE, default=None
    )
    section_modulus: Float[Number, ""] | None = number(
        "m^3", "bending moment over stress; negative for a fibre above the axis", default=None
    )
    mode_band: str = choice(
        "modes of the reading: all, or those up to the largest of 30 Hz, 1.5 f_1 and f_3"
        " (EN 1990, A2.4.4.2.1)",
        "all",
        "en1990",
        default="all",
    )
    name: str = choice("label in results; its number and quantity if left out", default="")
    side: str = choice(
        "side of the position on which it reads what jumps there; the right one if left out",
        "",
        *SIDES,
        default="",
        kw_only=True,
    )
    eccentricity: Float[Number, ""] | None = number(
        "m",
        "distance left of the axis of twist, looking right, as of an edge of the deck",
        default=None,
        kw_only=True,
    )
    dropout: Float[Number, ""] | None = number(
        "1", "probability that a reading is lost", PROBABILITY, default=None, kw_only=True
    )
    jitter: Float[Number, ""] | None = number(
        "s", "largest random delay of a reading", NOT_NEGATIVE, default=None, kw_only=True
    )

    def __post_init__(self):
        for name in ("offset", "noise", "range", "resolution"):
            value = getattr(self, name)
            if isinstance(value, str | list | tuple) and self.quantity in QUANTITIES:
                setattr(self, name, in_si(value, self.unit, name))

    @property
    def unit(self) -> str:
        """SI unit of the readings."""
        return QUANTITIES[self.quantity].unit

    @property
    def has_feedthrough(self) -> bool:
        """Whether forces and commands change the reading at once, as they change accelerations."""
        return QUANTITIES[self.quantity].time_derivative == 2

    @property
    def bends(self) -> bool:
        """Whether it measures curvature, or what follows from it by the section."""
        return QUANTITIES[self.quantity].bends

    @property
    def has_digital_filter(self) -> bool:
        """Whether a filter acts on its samples."""
        return self.filter is not None and self.filter.realisation == "digital"

    def sampled_features(self, address: str) -> Iterator[str]:
        """Features that a sensor has at samples only, each as the subject of an error message."""
        if self.has_digital_filter:
            yield f"{address}.filter, which is digital,"
        for name in ("sampling_period", "delay", "noise", "resolution", "dropout", "jitter"):
            if getattr(self, name) is not None:
                yield f"{address}.{name}"
        if self.has_feedthrough:
            yield f"the {self.quantity} of {address}"

    @property
    def noise_variance(self) -> Float[Array, ""]:
        """Variance of the noise of a reading, in the square of its unit; R of a Kalman filter."""
        return xp.zeros(()) if self.noise is None else self.noise**2

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        quantity, words = QUANTITIES[self.quantity], f"a sensor of {self.quantity}"
        if quantity.at_fibre and self.fibre_distance is None:
            return (
                f"{address}.fibre_distance is missing: {self.quantity} needs the height of the"
                " gauge above the neutral axis in m"
            )
        if not quantity.at_fibre and self.fibre_distance is not None:
            return (
                f"{address}.fibre_distance would have no effect on {words};"
                " leave it out, or set quantity to 'strain'"
            )
        modulus = self.section_modulus
        if quantity.over_modulus and modulus is None:
            return (
                f"{address}.section_modulus is missing: {self.quantity} needs bending moment over"
                " stress in m^3, negative for a fibre above the neutral axis"
            )
        if not quantity.over_modulus and modulus is not None:
            return (
                f"{address}.section_modulus would have no effect on {words};"
                " leave it out, or set quantity to 'stress'"
            )
        if self.mode_band != "all" and self.bends:
            return (
                f"{address}.mode_band would have no effect on {words}, which has all modes by the"
                " static correction; leave it out"
            )
        if self.side and not quantity.x_derivative:
            return (
                f"{address}.side would have no effect on {words}, which is the same on both sides;"
                " leave it out"
            )
        if self.eccentricity is not None and (quantity.x_derivative or quantity.of_twist):
            return (
                f"{address}.eccentricity would have no effect on {words}, which is that of the"
                " section; leave it out"
            )
        if modulus is not None and is_concrete(modulus) and concrete(modulus) == 0:
            return f"{address}.section_modulus must not be zero"
        return None


def sensor_labels(sensors: Sequence[Sensor]) -> list[str]:
    """Labels of sensors in results: their names, or number and quantity, as in "0: deflection"."""
    return [sensor.name or f"{i}: {sensor.quantity}" for i, sensor in enumerate(sensors)]
