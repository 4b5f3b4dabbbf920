"""Kinds: a class is found by the kind that it declares, without registration."""

import abc
import dataclasses
import importlib
import re
import subprocess
import sys
import tomllib
from typing import ClassVar

import equinox as eqx
import numpy as np
import pytest
from jaxtyping import Float

import jaxbeam as jb
import tuning
from jaxbeam.case import former_words
from jaxbeam.case.case import Case, addresses, crossing_times, part_classes, replace, stack_cases
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import POSITIVE, find_kind, import_modules, kind_of, kinds, number
from jaxbeam.case.trajectory import NEVER
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict, read_part
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


# Former words of case files, addresses, arguments and the package name the present ones.

FORMER_CASE = {
    "beam": {"length": 0.6, "flexural_rigidity": 11.68, "mass_per_length": 0.535, "modes": 1},
    "actuators": [{"kind": "point", "position": 0.3}],
    "sensors": [{"position": 0.3}],
    "loads": [{"kind": "mass", "mass": 0.3, "speed": 1.0}],
}
SCHEDULED = {"kind": "feedback-scheduled", "masses": [0.2, 0.6], "gains": [[2e3, 4e3]]}
GATES = {"gates": [-0.2, -0.1], "until": 0.3}

MOVED = {jb: former_words.MOVED, tuning: tuning.MOVED}


def with_controller(**table) -> jb.Case:
    return case_from_dict(FORMER_CASE | {"controller": table | {"period": 0.01}})


def test_present_words_exist():
    words, classes = former_words.WORDS, kinds(AbstractController)
    assert {words["passage"], words["relief"]} <= set(classes)
    assert not words.keys() & set(classes)
    assert {name.partition("(")[0] for name in former_words.NAMES.values()} <= {
        *jb.__all__,
        *former_words.MOVED,
    }
    assert not former_words.KINDS.keys() & set(classes)
    assert {kind for kind, _ in former_words.KINDS.values()} <= set(classes)
    assert not set(former_words.NAMES) & set(jb.__all__)


def test_former_words_are_refused():
    with pytest.raises(ValueError, match="kind cannot be 'relief'; it is called 'internal-model'"):
        with_controller(kind="relief", readings=[0.0, 1e-3], values=[[0.0, 1.0]])
    present = "'recognition'; it is called 'load_identification' now"
    with pytest.raises(ValueError, match=f"controller has no key {present}"):
        with_controller(**SCHEDULED, recognition=GATES)
    with pytest.raises(TypeError, match="ScheduledFeedback has no recognition; it is called"):
        jb.ScheduledFeedback(masses=[0.2], gains=[[2e3]], period=0.01, recognition=None)
    with pytest.raises(TypeError, match="LQR has no places; it is called 'positions' now"):
        jb.LQR([1.0], [1.0], places=[0.3])


@pytest.mark.parametrize(
    ("package", "name", "module"),
    [(one, *pair) for one in (jb, tuning) for pair in MOVED[one].items()],
)
def test_names_that_are_in_a_module_now(package, name, module):
    present = f"{package.__name__}.{module}"
    with pytest.raises(AttributeError, match=re.escape(f"{name} is {present}.{name} now")):
        getattr(package, name)
    found = getattr(package, module, None) or importlib.import_module(present)
    assert hasattr(found, name) and name not in package.__all__


@pytest.mark.parametrize(("old", "present"), former_words.KINDS.items())
def test_former_kinds_are_options_of_others(old, present):
    """Of which the case file is written as the sentence says."""
    kind, options = present
    message = re.escape(f"controller.kind cannot be {old!r}; it is kind {kind!r} with {options}")
    weights = {"state_weight": [1e4, 1.0], "command_weight": [1e-3]}
    with pytest.raises(ValueError, match=message):
        with_controller(kind=old, **weights)
    if kind == "lqr":
        further = {"masses": [0.2, 0.4]} if "schedule" in options else {}
        settings = tomllib.loads(options.replace(" and ", "\n"))
        check_case(with_controller(kind=kind, **weights, **settings, **further))


def test_former_addresses_are_refused():
    case = with_controller(**SCHEDULED, load_identification=GATES)
    present = "controller.load_identification.until"
    assert present in addresses(case)
    for use in (
        lambda old: jb.replace(case, {old: 0.4}),
        lambda old: jb.sweep(case, {old: [0.3, 0.4]}, progress=False),
    ):
        with pytest.raises(ValueError, match=f"did you mean '{present}'?"):
            use("controller.recognition.until")


@pytest.mark.parametrize(("old", "new"), former_words.NAMES.items())
def test_former_names_of_the_package_are_refused(old, new):
    with pytest.raises(AttributeError, match=re.escape(f"{old} is called jaxbeam.{new} now")):
        getattr(jb, old)


def test_words_of_files_that_python_has_not():
    profile = {"kind": "iso8608", "class": "B", "seed": 1}
    case = case_from_dict(FORMER_CASE | {"profile": profile})
    assert case.profile.road_class == "B"
    with pytest.raises(ValueError, match="class is called road_class in Python; leave one"):
        case_from_dict(FORMER_CASE | {"profile": profile | {"road_class": "B"}})


def test_unknown_name_of_the_package():
    with pytest.raises(AttributeError, match="no_such_name"):
        jb.no_such_name  # noqa: B018


def test_importing_the_package_does_not_import_jax():
    code = "import sys, jaxbeam; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
