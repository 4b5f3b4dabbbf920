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


TUNING = """
import jaxbeam as jb, tuning
case, loads = jb.load_case("examples/controlled_rig/case.toml"), {"loads.0.mass": 0.25}
try:
    tuning.tune(case, {"controller.gains.0": None}, tuning.LoadCases((loads,)), lambda x: 0.0)
except TypeError as error:
    assert "objective must be a tuning.Objective, not function; a function of" in str(error), error
else:
    raise AssertionError
"""


def test_it_is_said_that_an_objective_is_no_function():
    subprocess.run([sys.executable, "-c", TUNING], check=True, cwd=ROOT)
