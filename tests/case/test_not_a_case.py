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
    (lambda word: jb.statics.static_peak(case, 0.5, word), "layout takes what mesh_layout"),
    (lambda word: jb.influence_line(case, 0.5, layout=word), "layout takes a jaxbeam.Layout or"),
    (lambda word: jb.modes(case, word), "layout takes a jaxbeam.Layout or None"),
    (lambda word: jb.simulate(case, plan=word), "plan takes a jaxbeam.IntegrationPlan or None"),
    (lambda word: jb.sweep(case, word), "over takes a mapping by names or addresses"),
    (lambda word: jb.sweep(case, {}, paired=word), "paired takes True or False"),
    (lambda word: jb.assess(case, 40.0, dynamic=word), "dynamic takes True or False or None"),
    (lambda word: jb.bound(case, spacing=word), "spacing must be a real number"),
    (lambda word: jb.save(jb.simulate(case), "x.csv", word), "overwrite takes True or False"),
    (lambda word: jb.replace(case, word), "values map addresses to numbers"),
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
