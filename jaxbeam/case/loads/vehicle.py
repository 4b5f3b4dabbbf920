"""Loads that are vehicles in the plane, of the library or of files."""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx

from jaxbeam.case.fields import (
    choice,
    parts,
)
from jaxbeam.case.loads.base import AbstractRowLoad
from jaxbeam.case.loads.planar.vehicle import (
    PlanarVehicle,
    is_path,
    load_vehicle,
    unknown_vehicle,
    vehicle_names,
)
from jaxbeam.case.loads.planar.vehicle_parts import (
    VehicleAxle,
    VehicleBody,
    VehicleHinge,
    VehicleSpring,
)

DESCRIPTION = ("bodies", "springs", "hinges", "axles", "spacing")
IMPLIED = {"model": DESCRIPTION}  # entries of a load that follow from another one


class VehicleLoad(AbstractRowLoad):
    """Vehicle of the library, of a vehicle file, or of tables in the case; `count` in a row.

    `model` is a name of the library or the path of a vehicle file (see `planar.files`), whose
    numbers become those of the load: `loads.0.bodies.0.mass`. Tables beside a model replace those
    of the model. The load of a file keeps the numbers, not the path.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.VehicleLoad(model="half-truck", speed=20.0)],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.936 mm
    """

    kind: ClassVar[str] = "vehicle"

    model: str = choice("name of a vehicle of the library, or path of a vehicle file", default="")
    bodies: Sequence[VehicleBody] = parts("rigid bodies", VehicleBody)
    springs: Sequence[VehicleSpring] = parts("springs between bodies", VehicleSpring)
    hinges: Sequence[VehicleHinge] = parts("hinges between bodies", VehicleHinge)
    axles: Sequence[VehicleAxle] = parts("axles, front first", VehicleAxle)

    def __post_init__(self):
        if not isinstance(self.model, str) or not (
            is_path(self.model) or self.model in vehicle_names()
        ):
            return  # none, or one that `validate` refuses
        vehicle = load_vehicle(self.model)
        for name in DESCRIPTION:
            value = getattr(self, name)
            if value is None or (isinstance(value, tuple | list) and not value):
                setattr(self, name, getattr(vehicle, name))
        if is_path(self.model):
            self.model = ""

    def implied_fields(self) -> tuple[str, ...]:
        """Names of the fields that follow from the model."""
        if self.model not in vehicle_names():
            return ()
        vehicle = load_vehicle(self.model)
        return tuple(
            name
            for name in DESCRIPTION
            if eqx.tree_equal(getattr(self, name), getattr(vehicle, name)) is True
        )

    def by_numbers(self):
        return dataclasses.replace(self, model="")

    def planar_vehicle(self) -> PlanarVehicle:
        """Description of one of its vehicles."""
        return PlanarVehicle(
            bodies=self.bodies, springs=self.springs, hinges=self.hinges, axles=self.axles
        )

    def validate(self, address):
        if self.model and self.model not in vehicle_names():
            return f"{address}.model: {unknown_vehicle(self.model)}"
        if not self.bodies:
            return (
                f"{address} has neither model nor bodies; name a vehicle of the library, or give a"
                " vehicle file"
            )
        error = self.planar_vehicle().validate(address) or super().validate(address)
        wheelbase = self.axles[0].position - self.axles[-1].position if self.axles else 0.0
        return error or self.overlap_error(address, wheelbase, "vehicle")

    def vehicle(self, gravity):
        return self.planar_vehicle().model(gravity)
