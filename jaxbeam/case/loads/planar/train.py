"""Train of unlike vehicles, such as a locomotive and its coaches, as one load."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case import fields
from jaxbeam.case.fields import POSITIVE, choice, concrete, is_concrete, number, parts
from jaxbeam.case.loads.base import AbstractVehicleLoad
from jaxbeam.case.loads.planar.files import is_path, load_vehicle, unknown_vehicle, vehicle_names
from jaxbeam.case.loads.planar.vehicle import PlanarVehicle
from jaxbeam.case.loads.vehicle_model import VehicleModel
from jaxbeam.runtime.arrays import Array, block_diag, xp
from jaxbeam.runtime.module import Module

PER_WHEEL = ("static_loads", "wheel_masses", "contact_stiffness", "contact_damping")
MATRICES = ("mass", "damping", "stiffness")


class Coach(Module):
    """Vehicles of one kind in a train, `count` one behind the other.

    `length` over couplers is that of the vehicle file if it is left out; the wheels are in the
    middle of it.

    >>> import jaxbeam as jb
    >>> coach = jb.Coach("manchester-wagon", count=4)
    >>> print(coach.count, "coaches of", coach.coupler_length(), "m")
    4 coaches of 25.0 m
    """

    model: str = choice("name of a vehicle of the library, or path of a vehicle file")
    count: int = fields.count("number of vehicles in a row", default=1)
    length: Float[Array, ""] | None = number("m", "length over couplers", POSITIVE, default=None)

    def vehicle(self) -> PlanarVehicle:
        """The vehicle of its file, or of the library."""
        return load_vehicle(self.model)

    def coupler_length(self) -> Float[Array, ""] | None:
        """Length over couplers (m); None if neither it nor the file gives one."""
        return self.vehicle().spacing if self.length is None else self.length


class TrainLoad(AbstractVehicleLoad):
    """Vehicles of several kinds, `coaches` from the front on, coupled without forces between them.

    They are one load with one trajectory, that of the first wheel of the train.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.TrainLoad(speed=50.0, coaches=[jb.Coach("manchester-wagon", count=2)])],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    7.645 mm
    """

    kind: ClassVar[str] = "train"

    coaches: tuple[Coach, ...] = parts("vehicles, front first", Coach)

    def validate(self, address):
        if not self.coaches:
            return f"{address}.coaches has no entry; give at least one vehicle, with its model"
        for i, coach in enumerate(self.coaches):
            own = f"{address}.coaches.{i}"
            if not is_path(coach.model) and coach.model not in vehicle_names():
                return f"{own}.model: {unknown_vehicle(coach.model)}"
            length = coach.coupler_length()
            if length is None:
                return (
                    f"{own}.length is missing, and {coach.model} has no spacing in its file; give"
                    " the length over couplers in m"
                )
            axles = coach.vehicle().axles
            wheelbase = concrete(axles[0].position - axles[-1].position)
            if is_concrete(length) and concrete(length) <= wheelbase:
                return (
                    f"{own}.length must exceed the wheelbase of {coach.model}, {wheelbase:g} m; it"
                    f" is {concrete(length):g} m"
                )
        return super().validate(address)

    def vehicle(self, gravity):
        models, behind, end = [], [], 0.0
        for coach in self.coaches:
            model, length = coach.vehicle().model(gravity), coach.coupler_length()
            overhang = (length - model.offsets[-1]) / 2
            for _ in range(coach.count):
                models.append(model)
                behind.append(end + overhang + model.offsets)
                end = end + length
        behind = [offsets - behind[0][0] for offsets in behind]
        return _coupled(models, behind)


def _coupled(models: list[VehicleModel], behind) -> VehicleModel:
    """Vehicles one behind the other as one; names begin with the number of each, from 1."""
    names = tuple(f"coach {i + 1} {name}" for i, one in enumerate(models) for name in one.names)
    rows, column = [], 0
    for one in models:
        size, dofs = one.wheel_map.shape
        rest = len(names) - column - dofs
        row = xp.zeros((size, column)), one.wheel_map, xp.zeros((size, rest))
        rows.append(xp.concatenate(row, axis=1))
        column += dofs
    lists = {name: xp.concatenate([getattr(one, name) for one in models]) for name in PER_WHEEL}
    matrices = {name: block_diag(*(getattr(one, name) for one in models)) for name in MATRICES}
    offsets, wheel_map = xp.concatenate(behind), xp.concatenate(rows)
    return VehicleModel(offsets=offsets, wheel_map=wheel_map, names=names, **lists, **matrices)
