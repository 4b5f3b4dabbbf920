"""Actuators, one kind a file, behind the interface in `base`."""

from jaxbeam.actuators.base import AbstractActuator, Attachment, Bonded
from jaxbeam.actuators.electrodynamic import Electrodynamic
from jaxbeam.actuators.patch import Patch
from jaxbeam.actuators.point import PointForce
from jaxbeam.actuators.shaker import Shaker
from jaxbeam.actuators.spring import SpringDamper

KINDS = {
    "point": PointForce,
    "shaker": Shaker,
    "electrodynamic": Electrodynamic,
    "patch": Patch,
    "spring": SpringDamper,
}

__all__ = [
    "KINDS",
    "AbstractActuator",
    "Attachment",
    "Bonded",
    "Electrodynamic",
    "Patch",
    "PointForce",
    "Shaker",
    "SpringDamper",
]
