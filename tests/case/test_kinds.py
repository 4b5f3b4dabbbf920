"""Kinds: a class is found by the kind that it declares, without registration."""

import abc
import dataclasses
from typing import ClassVar

import equinox as eqx
import numpy as np
import pytest
from jaxtyping import Float

import jaxbeam as jb
from jaxbeam.case.case import Case, crossing_times, part_classes, replace, stack_cases
from jaxbeam.case.fields import POSITIVE, find_kind, import_modules, kind_of, kinds, number
from jaxbeam.case.trajectory import NEVER
from jaxbeam.files.case_file import read_part
from jaxbeam.runtime.arrays import Array


class AbstractMassDamper(eqx.Module):
    """A family of parts that exists in this file only."""

    kind: ClassVar[str]

    @abc.abstractmethod
    def frequency(self) -> Float[Array, ""]:
        """Natural frequency in Hz."""


class Tuned(AbstractMassDamper):
    """A member with a kind."""

    kind: ClassVar[str] = "tuned"

    tuning: Float[Array, ""] = number("Hz", "natural frequency", POSITIVE)

    def frequency(self):
        return self.tuning


class Untuned(Tuned):
    """A member that declares no kind of its own."""


def test_class_is_found_by_its_kind():
    assert kinds(AbstractMassDamper) == {"tuned": Tuned}
    assert find_kind(AbstractMassDamper, "tuned") is Tuned
    assert find_kind(AbstractMassDamper, "point") is None
    damper = read_part("dampers.0", {"kind": "tuned", "tuning": 3}, AbstractMassDamper)
    assert type(damper) is Tuned and damper.tuning == 3.0
    with pytest.raises(ValueError, match=r"dampers.0.kind cannot be 'tund'; did you mean 'tuned'"):
        read_part("dampers.0", {"kind": "tund"}, AbstractMassDamper)


def test_kind_is_not_inherited():
    assert kind_of(Tuned) == "tuned" and kind_of(Untuned) is None


def test_class_defined_again_takes_the_place_of_the_former_one():
    def define():
        class Rubber(AbstractMassDamper):
            kind: ClassVar[str] = "rubber"

        return Rubber

    former, latter = define(), define()
    assert former is not latter and kinds(AbstractMassDamper)["rubber"] is latter


def test_two_classes_of_one_kind_are_refused():
    class AbstractSpring(eqx.Module):
        @abc.abstractmethod
        def stiffness(self): ...

    class Coil(AbstractSpring):
        kind: ClassVar[str] = "spring"

    class Leaf(AbstractSpring):
        kind: ClassVar[str] = "spring"

    with pytest.raises(TypeError, match=r"'spring' is declared by both .*Coil and .*Leaf"):
        kinds(AbstractSpring)
    assert Leaf is not Coil


def test_parts_of_a_case_follow_from_its_fields():
    classes = {key: found.part_class.__name__ for key, found in part_classes().items()}
    assert classes == {
        "beam": "Beam",
        "supports": "Support",
        "absorbers": "Absorber",
        "actuators": "AbstractActuator",
        "sensors": "Sensor",
        "loads": "AbstractLoad",
        "vehicle_sensors": "VehicleSensor",
        "track": "Track",
        "profile": "AbstractProfile",
        "controller": "AbstractController",
        "contact": "AbstractContact",
        "run": "Run",
    }
    assert {*classes, "title"} == set(Case.__dataclass_fields__)
    assert [key for key, found in part_classes().items() if found.listed] == [
        *("supports", "absorbers", "actuators", "sensors", "loads", "vehicle_sensors")
    ]


@pytest.mark.parametrize("key", ["actuators", "loads", "profile", "controller"])
def test_every_class_of_a_case_has_a_kind(key):
    import_modules("jaxbeam.c_code")  # has a private member of a family
    family = part_classes()[key].part_class
    found = {each for each in kinds(family).values() if each.__module__.startswith("jaxbeam.")}
    assert all(find_kind(family, kind) is each for kind, each in kinds(family).items())
    public = {
        each
        for each in _subclasses(family)
        if each.__module__.startswith("jaxbeam.")
        and not each.__name__.startswith(("Abstract", "_"))
    }
    assert public == found


def _subclasses(part_class):
    return {
        subclass for each in part_class.__subclasses__() for subclass in {each, *_subclasses(each)}
    }


# Cases stacked along a first axis, and times at which loads enter and leave.

CASE = jb.Case(
    jb.Beam(length=1.2, flexural_rigidity=10.0, mass_per_length=1.0),
    loads=[
        jb.MovingMass(mass=0.5, speed=-2.0, entry_time=0.1),
        jb.MovingMass(mass=0.5, speed=1.0, deceleration=1.0),  # stops after 0.5 m
    ],
)


def test_crossing_times():
    np.testing.assert_allclose(crossing_times(CASE), [[0.1, 0.7], [0.0, NEVER]])
    assert crossing_times(dataclasses.replace(CASE, loads=())).shape == (0, 2)


def test_stacked_cases_have_all_numbers_along_a_first_axis():
    stacked = stack_cases([CASE, replace(CASE, {"beam.length": 2.0})])
    assert stacked.beam.length.tolist() == [1.2, 2.0]
    assert stacked.loads[0].speed.tolist() == [-2.0, -2.0]
