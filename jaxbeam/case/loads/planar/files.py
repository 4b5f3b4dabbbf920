"""Vehicles from files, and from the library by name.

A vehicle file is TOML with the keys of `PlanarVehicle`:

    title = "Tractor and trailer"
    source = "measured"
    [[bodies]]                       # name, mass, inertia (left out: no pitch), position
    name = "tractor"
    mass = 4500.0                    # kg
    inertia = 4604.0                 # kg m^2
    position = 0.0                   # m, centre of mass; forward positive, from any origin
    [[springs]]                      # between bodies: first, second, position, stiffness, damping,
    ...                              # rotational_stiffness, rotational_damping
    [[hinges]]                       # first, second, position
    first = "tractor"
    second = "trailer"
    position = -2.15
    [[axles]]                        # front first
    body = "tractor"
    position = 0.5
    mass = 700.0
    suspension_stiffness = 4.0e5     # N/m; left out: the axle is part of the body
    suspension_damping = 1.0e3
    tyre_stiffness = 1.75e6          # left out: the mass of the axle stays on the surface
    tyre_damping = 1.0e4
"""

import functools
import os
import tomllib
from importlib import resources

from jaxbeam.case.declared_checks import check_fields, suggestion
from jaxbeam.case.loads.planar.vehicle import PlanarVehicle
from jaxbeam.case.reading.parts import read_part
from jaxbeam.case.reading.toml_file import read_toml


def is_path(model: str) -> bool:
    """Whether the model of a vehicle is the path of a file, not a name of the library."""
    return model.endswith(".toml")


@functools.cache
def vehicle_names() -> tuple[str, ...]:
    """Names of the vehicles of the library."""
    folder = resources.files("jaxbeam.vehicles") / "models"
    names = (entry.name for entry in folder.iterdir())
    return tuple(sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml")))


def load_vehicle(model: str | os.PathLike) -> PlanarVehicle:
    """The validated vehicle of a file, whose name ends in .toml, or of the library.

    Raises ValueError for an unknown name, and with the file and the address for whatever is wrong
    in a file; OSError if it cannot be read.

    `model` is the name, or the path of the file.

    >>> import jaxbeam as jb
    >>> print(jb.load_vehicle("truck-5-axle").title)
    Articulated truck: tractor with two axles, trailer with three
    """
    if isinstance(model, str) and not is_path(model):
        if model not in vehicle_names():
            raise ValueError(unknown_vehicle(model))
        return _library_vehicle(model)
    content = read_toml(model, "vehicle file")
    try:
        vehicle = read_part("", content, PlanarVehicle)
        check_vehicle(vehicle)
    except ValueError as error:
        raise ValueError(f"{model}: {str(error).lstrip('. ')}") from None
    return vehicle


def unknown_vehicle(name: str) -> str:
    """Error message for a name that the library does not have."""
    return (
        f"there is no vehicle {name!r} in the library (the name of a file ends in .toml);"
        f" {suggestion(name, vehicle_names())}"
    )


def check_vehicle(vehicle: PlanarVehicle) -> None:
    """Validate a vehicle; raises ValueError with the address of the first error."""
    check_fields("", vehicle)
    error = vehicle.validate("")
    if error is not None:
        raise ValueError(error)


@functools.cache
def _library_vehicle(name: str) -> PlanarVehicle:
    text = (resources.files("jaxbeam.vehicles") / "models" / f"{name}.toml").read_text("utf-8")
    return read_part("", tomllib.loads(text), PlanarVehicle)
