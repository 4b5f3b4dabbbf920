"""Springs and dampers of vehicles with the masses that they carry, whatever the kind of load."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxbeam.case.loads.base import AbstractLoad

UNIT_GRAVITY = np.ones(())


class SuspensionStage(NamedTuple):
    """Spring (N/m) and damper (N s/m) of a vehicle with their addresses, and mass carried (kg)."""

    spring: str
    damper: str
    stiffness: float
    damping: float
    carried: float


def stages(address: str, load: AbstractLoad) -> Iterator[SuspensionStage]:
    """Stages of a vehicle at an address, from below; none of loads without springs."""
    vehicle: Any = load
    match load.kind:
        case "oscillator":
            names = "stiffness", "damping"
            yield _stage(address, vehicle, names, float(vehicle.mass))
        case "quarter-car" | "half-car":
            on_wheels = load.vehicle(UNIT_GRAVITY).static_loads
            axles = np.reshape(
                getattr(vehicle, "axle_masses", getattr(vehicle, "axle_mass", 0)), -1
            )
            for part, carried in (("tyre", on_wheels), ("suspension", on_wheels - axles)):
                names = f"{part}_stiffness", f"{part}_damping"
                yield from _per_axle(address, vehicle, names, carried)
        case "wagon":
            on_wheel = float(load.vehicle(UNIT_GRAVITY).static_loads[0])
            carried = on_wheel - float(vehicle.wheelset_mass)
            yield _stage(address, vehicle, ("primary_stiffness", "primary_damping"), carried)
            names = "secondary_stiffness", "secondary_damping"
            yield _stage(address, vehicle, names, float(vehicle.body_mass) / 2)
        case "vehicle":
            yield from _planar_stages(address, vehicle)


def _planar_stages(address: str, vehicle: Any) -> Iterator[SuspensionStage]:
    model = vehicle.vehicle(UNIT_GRAVITY)
    for part in ("tyre", "suspension"):
        for i, axle in enumerate(vehicle.axles):
            if getattr(axle, f"{part}_stiffness") is not None:
                carried = float(model.static_loads[i])
                carried -= 0.0 if part == "tyre" else float(axle.mass)
                names = f"{part}_stiffness", f"{part}_damping"
                yield _stage(f"{address}.axles.{i}", axle, names, carried)
    heights = [0.0 if name.endswith(" pitch") else 1.0 for name in model.names]
    sag = np.linalg.solve(model.full_stiffness, model.mass @ np.array(heights))
    motion = dict(zip(model.names, sag, strict=True))
    for i, spring in enumerate(vehicle.springs):
        first, second = (
            _sag_at(vehicle, motion, name, spring.position)
            for name in (spring.first, spring.second)
        )
        if first is not None and second is not None and float(spring.stiffness):
            carried = abs(first - second) * float(spring.stiffness)
            yield _stage(f"{address}.springs.{i}", spring, ("stiffness", "damping"), carried)


def _sag_at(vehicle: Any, motion: dict[str, float], name: str, position) -> float | None:
    """Sag of a body at a position under unit gravity; None of one whose height a hinge sets."""
    body = next((body for body in vehicle.bodies if body.name == name), None)
    if body is None or name not in motion:
        return None
    lever = float(position) - float(body.position)
    return motion[name] + lever * motion.get(f"{name} pitch", 0.0)


def _stage(address: str, part: Any, names: tuple[str, str], carried: float) -> SuspensionStage:
    spring, damper = (f"{address}.{name}" for name in names)
    stiffness, damping = (float(getattr(part, name)) for name in names)
    return SuspensionStage(spring, damper, stiffness, damping, carried)


def _per_axle(
    address: str, part: Any, names: tuple[str, str], carried
) -> Iterator[SuspensionStage]:
    stiffness, damping = (np.ravel(getattr(part, name)) for name in names)
    for i, mass in enumerate(carried):
        entry = f".{i}" if np.ndim(getattr(part, names[0])) else ""
        spring, damper = (f"{address}.{name}{entry}" for name in names)
        yield SuspensionStage(spring, damper, float(stiffness[i]), float(damping[i]), float(mass))
