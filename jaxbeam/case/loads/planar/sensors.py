"""Sensors on vehicles, of a body or an axle."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.display.parts import ReprWithUnits
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    POSITIVE,
    PROBABILITY,
    choice,
    count,
    number,
    part,
)
from jaxbeam.case.filters import Filter
from jaxbeam.case.quantities import BODY_QUANTITIES, OF_QUANTITY, QUANTITIES
from jaxbeam.case.reading.units import in_si
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.module import Module


class VehicleSensor(ReprWithUnits, Module):
    """Sensor of the vertical motion of a body or an axle of a vehicle, positive upwards.

    `load` is the number of the load, `vehicle` that of the vehicle in its row, both from 0; `body`
    a name of `Record.bodies` without the load, as "body" or "axle 1". At `position` (m) forward of
    the centre of mass it feels the pitch as well. Displacements are from static equilibrium. The
    other entries are those of `Sensor`.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3),
    ...     loads=[jb.VehicleLoad(model="half-truck", speed=20.0)],
    ...     vehicle_sensors=[jb.VehicleSensor(body="axle 1", quantity="acceleration")],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(case.vehicle_sensors[0].unit)
    m/s^2
    """

    # What a sensor on the beam may have and this one has not.
    range: ClassVar[None] = None
    resolution: ClassVar[None] = None
    has_feedthrough: ClassVar[bool] = True  # there is no history of the rate of an acceleration
    bends: ClassVar[bool] = False

    load: int = count("number of the load, from 0", minimum=0, default=0)
    body: str = choice("name of the body or axle", default="body")
    quantity: str = choice("measured quantity", *BODY_QUANTITIES, default="acceleration")
    vehicle: int = count("number of the vehicle in a row, from 0", minimum=0, default=0)
    position: Float[Array, ""] = number("m", "forward of the centre of mass", default=0.0)
    offset: Float[Array, ""] = number(OF_QUANTITY, "constant added", default=0.0)
    noise: Float[Array, ""] | None = number(
        OF_QUANTITY, "standard deviation of white noise", NOT_NEGATIVE, default=None
    )
    filter: Filter | None = part("filter of the signal or of its samples", Filter)
    sampling_period: Float[Array, ""] | None = number(
        "s", "time between readings; that of the run if left out", POSITIVE, default=None
    )
    delay: Float[Array, ""] | None = number(
        "s", "from motion to reading", NOT_NEGATIVE, default=None
    )
    dropout: Float[Array, ""] | None = number(
        "1", "probability that a reading is lost", PROBABILITY, default=None, kw_only=True
    )
    jitter: Float[Array, ""] | None = number(
        "s", "largest random delay of a reading", NOT_NEGATIVE, default=None, kw_only=True
    )

    def __post_init__(self):
        for name in ("offset", "noise"):
            value = getattr(self, name)
            if isinstance(value, str) and self.quantity in BODY_QUANTITIES:
                setattr(self, name, in_si(value, self.unit, name))

    @property
    def unit(self) -> str:
        """SI unit of the readings."""
        return QUANTITIES[BODY_QUANTITIES[self.quantity]].unit
