"""Actuators, with the interface of `base`."""

from jaxbeam.case.actuators.base import Patch, PointForce, Shaker, SpringDamper
from jaxbeam.case.actuators.electrodynamic import CurrentLoop, Electrodynamic, ForceLoop
from jaxbeam.case.actuators.hysteresis import Creep, Hysteresis

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
