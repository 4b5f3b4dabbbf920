"""Actuators, one kind a file, with the interface of `base`."""

from jaxbeam.case.actuators.electrodynamic import CurrentLoop, Electrodynamic, ForceLoop
from jaxbeam.case.actuators.hysteresis import Creep, Hysteresis
from jaxbeam.case.actuators.patch import Patch
from jaxbeam.case.actuators.point import PointForce, Shaker, SpringDamper

__all__ = [
    "Creep",
    "CurrentLoop",
    "Electrodynamic",
    "ForceLoop",
    "Hysteresis",
    "Patch",
    "PointForce",
    "Shaker",
    "SpringDamper",
]
