"""Functions of a case that are given a part of one, or the path of its file; other wrong types."""

import subprocess
import sys

from tests.modules import ROOT

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
log = tuning.read_log("jaxbeam/demo/log_1.csv")
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

OTHERS = ("c_code", "fmi", "files.export", "plot", "benchmark", "rigs")
PARTS = ("jaxbeam.case.", "jaxbeam.control.", "jaxbeam.estimation.", "tuning.control.")  # of cases
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
