"""Vehicles in the plane, of bodies on axles, springs and hinges."""

from jaxbeam.case.loads.planar.vehicle_parts import (
    VehicleAxle,
    VehicleBody,
    VehicleHinge,
    VehicleSensor,
    VehicleSpring,
)

__all__ = [
    "VehicleAxle",
    "VehicleBody",
    "VehicleHinge",
    "VehicleSensor",
    "VehicleSpring",
]
