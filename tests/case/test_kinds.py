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
from tests.modules import ROOT


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
    import_modules("jaxbeam.export")  # has a private member of a family
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


# Functions of a case that are given a part of one, or the path of its file; other wrong types.

SCRIPT = """
import jaxbeam as jb
beam = jb.Beam(0.6, 11.68, 0.535)
calls = {
    "simulate": (), "modes": (), "state_space": (), "check": (), "Simulator": (), "envelope": (),
    "sweep": ({"loads.0.mass": [0.1]},), "frequency_response": ([1.0],), "influence_line": (0.3,),
    "save_case": ("case.toml",), "bound": (),
}
for name, others in calls.items():
    for given in (beam, "case.toml"):
        try:
            getattr(jb, name)(given, *others)
        except TypeError as error:
            assert "a jaxbeam.Case is needed, not a " in str(error), (name, error)
        else:
            raise AssertionError(name)
"""


def test_it_is_said_that_a_case_is_needed(tmp_path):
    """It was said that a Beam has no `supports`. In a process without the check of types."""
    subprocess.run([sys.executable, "-c", SCRIPT], check=True, cwd=tmp_path)


WORDS = """
import jaxbeam as jb
from jaxbeam.analysis.combinations import combine
from jaxbeam.analysis.load_models import crossing_envelope, load_model_envelope
case = jb.Case(
    jb.Beam(1.0, 11.68, 0.535), sensors=[jb.Sensor(0.5)],
    loads=[jb.MovingMass(mass=0.5, speed=2.0)],
)
x, places = "x takes positions in m", "load_positions takes positions in m"
number = "tolerance takes one number"
asked = [
    (lambda word: jb.influence_line(case, 0.5, word), places),
    (lambda word: jb.influence_line(case, word), x),
    (lambda word: jb.statics.static_peak(case, word), x),
    (lambda word: jb.statics.static_deflection(case, 0.5, word), places),
    (lambda word: jb.envelope(case, word), x),
    (lambda word: jb.sections.influence_table(case, ["moment"], word), x),
    (lambda word: jb.sections.influence_table(case, ["moment"], None, word), places),
    (lambda word: jb.frequency_response(case, word), "frequencies takes numbers in Hz"),
    (lambda word: jb.simulate(case, times=word), "times takes numbers in s"),
    (lambda word: jb.Simulator(case, times=word), "times takes numbers in s"),
    (lambda word: jb.Simulator(case, {"loads.0.speed": (1.0, word)}), "the range of loads.0.s"),
    (lambda word: jb.Simulator(case, tolerance=word), number),
    (lambda word: jb.simulate(case, tolerance=word), number),
    (lambda word: jb.sweep(case, {"loads.0.speed": [1.0]}, tolerance=word), number),
    (lambda word: jb.envelope(case, tolerance=word), number),
    (lambda word: jb.assess(case, 40.0, classification=word), "classification takes a plain"),
    (
        lambda word: combine(case, {"a": {"uniform": 1.0}}, {"c": {"a": word}}, [0.5]),
        "combinations.c.a is a factor, or two",
    ),
    (
        lambda word: combine(case, {"a": {"uniform": 1.0}}, {"c": word}, [0.5]),
        "combinations takes a mapping of mappings",
    ),
    (lambda word: combine(case, {"a": word}, {}, [0.5]), "actions takes a mapping of mappings"),
    (lambda word: load_model_envelope(case, "LM1", [0.5], lane=word), "lane takes a number in N/m"),
    (lambda word: crossing_envelope(case, "LM1", word, [0.5]), "speed takes a number in m/s"),
    (lambda word: load_model_envelope(case, "LM1", word), "x must be a real number"),
    (lambda word: jb.ride.weighted_rms(word, [1.0]), "times takes numbers in s"),
    (lambda word: jb.ride.sperling_index([0.0], word), "acceleration takes numbers in m/s^2"),
    (lambda word: jb.statics.static_peak(case, 0.5, word), "layout takes a jaxbeam.Layout or"),
    (lambda word: jb.influence_line(case, 0.5, layout=word), "layout takes a jaxbeam.Layout or"),
    (lambda word: jb.modes(case, word), "layout takes a jaxbeam.Layout or None"),
    (lambda word: jb.simulate(case, plan=word), "plan takes a jaxbeam.IntegrationPlan or None"),
    (lambda word: jb.sweep(case, word), "over takes a mapping by names or addresses"),
    (lambda word: jb.sweep(case, {}, paired=word), "paired takes True or False"),
    (lambda word: jb.assess(case, 40.0, dynamic=word), "dynamic takes True or False or None"),
    (lambda word: jb.bound(case, spacing=word), "spacing must be a real number"),
    (lambda word: jb.save(jb.simulate(case), "x.csv", word), "overwrite takes True or False"),
    (lambda word: jb.replace(case, word), "values takes a mapping by names"),
]
for ask, message in asked:
    try:
        ask("moment")
    except (TypeError, ValueError) as error:
        assert str(error).startswith(message) and "'moment'" in str(error), (message, error)
    else:
        raise AssertionError(message)
for measure in (jb.ride.weighted_rms, jb.ride.sperling_index):
    try:  # the index of fewer accelerations than times was that of another duration
        measure([0.0, 0.005, 0.01, 0.015], [0.0, 0.1, 0.0])
    except ValueError as error:
        assert "one for each of the times" in str(error), error
    else:
        raise AssertionError(measure)
assert jb.influence_line(case, "0.5 m", 0.2) == jb.influence_line(case, 0.5, 0.2)
"""


def test_it_is_said_that_a_word_is_no_number(tmp_path):
    """Quantities given where positions are expected: it was said that they are no floats."""
    subprocess.run([sys.executable, "-c", WORDS], check=True, cwd=tmp_path)


TUNING = """
import jaxbeam as jb, tuning
case, loads = jb.load_case("examples/controlled_rig/case.toml"), {"loads.0.mass": 0.25}
free, loads = {"controller.gains.0": None}, tuning.LoadCases((loads,))
log = tuning.read_log("jaxbeam/case/library/demo/log_1.csv")
objective = "objective takes a tuning.Objective or None, not a function; a function of your own"
a_log = "logs takes a tuning.Log or a list of tuning.Log, not"
of_a_word = [
    (lambda word: tuning.identify(case, word, "beam.length"), f"{a_log} 'x'; tuning.read_log"),
    (lambda word: tuning.identify(case, [log, word], "beam.length"), f"{a_log} ["),
    (lambda word: tuning.identify(case, log, ["beam.length", 3]), "free takes a mapping"),
    (lambda word: tuning.identify(case, log, "beam.length", starts=word), "starts takes a whole n"),
    (lambda word: tuning.identify(case, log, "beam.length", resume=word), "resume takes True or"),
    (lambda word: tuning.tune(case, free, word), "a tuning.LoadCases is needed, not a str; make"),
    (lambda word: tuning.tune(case, free, loads, steps=word), "steps takes a whole number, not"),
    (lambda word: tuning.tune(case, free, loads, lambda values: 0.0), objective),
    (lambda word: tuning.weigh(case, word, (1.0, 2.0)), "a tuning.Log is needed, not a str;"),
    (lambda word: tuning.weigh(case, log, (1.0,)), "speeds takes a list of 2 numbers, not"),
    (lambda word: tuning.identify_modes(log, band=word), "band takes a list of 2 numbers or None"),
    (lambda word: tuning.identify_from_modes(case, word, free), "a tuning.ModalEstimates is n"),
    (lambda word: tuning.full_grid(word), "values takes a mapping by names or addresses"),
    (lambda word: tuning.full_grid({"loads.0.mass": word}), "loads.0.mass: give a list of numbers"),
]
for ask, message in of_a_word:
    try:
        ask("x")
    except (TypeError, ValueError) as error:
        assert str(error).startswith(message), (message, error)
    else:
        raise AssertionError(message)
"""


def test_it_is_said_of_what_class_an_argument_of_a_fit_is():
    """It was said that a str has no `valid`, and words were taken as True."""
    subprocess.run([sys.executable, "-c", TUNING], check=True, cwd=ROOT)


EVERY = """
import inspect, types, typing
from importlib import import_module
import jaxbeam, tuning
from jaxbeam.case.arguments import fits

OTHERS = ("export", "plot", "benchmark", "case.library.rigs")
PARTS = ("jaxbeam.case.", "jaxbeam.control.", "tuning.control.")  # of cases
FITTING = {int: 1, bool: False, str: "x"}
modules = [jaxbeam, tuning, *(import_module(f"jaxbeam.{name}") for name in OTHERS)]
modules += [one for m in modules[:2] for n in m.__all__ if inspect.ismodule(one := getattr(m, n))]


def names_of(module):
    own = {n for n, one in vars(module).items() if getattr(one, "__module__", 0) == module.__name__}
    return getattr(module, "__all__", [name for name in own if not name.startswith("_")])


public = {f"{m.__name__}.{name}": getattr(m, name) for m in modules for name in names_of(m)}


def value_of(declared):
    "One of a declared class that is good for nothing else."
    origin, parts = typing.get_origin(declared), typing.get_args(declared)
    if origin in (typing.Union, types.UnionType):
        return value_of(parts[0])
    if origin is not None:
        return next((one for one in ([], {}, print) if fits(one, declared)), parts)
    if not str(getattr(declared, "__module__", "")).startswith(("jaxbeam.", "tuning.")):
        return FITTING.get(declared, 0.5)
    return (tuple if issubclass(declared, tuple) else object).__new__(declared)


calls = {}
for name, one in public.items():
    if not inspect.isclass(one):
        calls |= {name: (one, None)} if callable(one) else {}
    elif not one.__module__.startswith(PARTS):  # whose methods are called by the rest
        methods = inspect.getmembers(one, inspect.isfunction)
        calls |= {f"{name}.{key}": (m, one) for key, m in methods if not key.startswith("_")}
checked = 0
for name, (function, owner) in calls.items():
    declared = {n: p for n, p in inspect.signature(function).parameters.items() if n != "self"}
    first = [value_of(owner)] * (owner is not None)
    needed = {n: value_of(p.annotation) for n, p in declared.items() if p.default is p.empty}
    for argument, declaration in declared.items():
        for value in (3, "x", types, [types]):
            if fits(value, declaration.annotation):
                continue
            try:
                function(*first, **needed | {argument: value})
            except (TypeError, ValueError) as error:
                place = error.__traceback__
                while place.tb_next:
                    place = place.tb_next
                file = place.tb_frame.f_code.co_filename
                assert "/jaxbeam/" in file or "/tuning/" in file, (name, argument, value, error)
                checked += 1
            else:
                raise AssertionError((name, argument, value))
assert checked > 1000
"""


def test_every_public_function_says_of_what_class_its_arguments_are():
    """Names of exports, paths and records of other classes ended in an AttributeError."""
    subprocess.run([sys.executable, "-c", EVERY], check=True, cwd=ROOT)
