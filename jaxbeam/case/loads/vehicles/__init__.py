"""Vehicles: half cars and wagons, any vehicle in the plane of bodies on axles, springs and hinges,
and trains of them.
"""

from jaxbeam.case.loads.vehicles.cars import HalfCar, Oscillator, QuarterCar, Wagon
from jaxbeam.case.loads.vehicles.vehicle import Coach, TrainLoad, VehicleLoad, load_vehicle
from jaxbeam.case.loads.vehicles.vehicle_parts import (
    VehicleAxle,
    VehicleBody,
    VehicleHinge,
    VehicleSensor,
    VehicleSpring,
)

__all__ = [
    "Coach",
    "HalfCar",
    "Oscillator",
    "QuarterCar",
    "TrainLoad",
    "VehicleAxle",
    "VehicleBody",
    "VehicleHinge",
    "VehicleLoad",
    "VehicleSensor",
    "VehicleSpring",
    "Wagon",
    "load_vehicle",
]
