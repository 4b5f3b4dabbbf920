"""Actuators, one kind a file, behind the interface in `base`."""

from jaxbeam.case.actuators.base import AbstractActuator, Attachment, SectionStiffening
from jaxbeam.case.actuators.electrodynamic import Electrodynamic
from jaxbeam.case.actuators.patch import Patch
from jaxbeam.case.actuators.point import PointForce
from jaxbeam.case.actuators.shaker import Shaker
from jaxbeam.case.actuators.spring import SpringDamper

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
    "SectionStiffening",
    "Electrodynamic",
    "Patch",
    "PointForce",
    "Shaker",
    "SpringDamper",
]
