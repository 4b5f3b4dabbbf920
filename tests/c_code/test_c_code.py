"""C code of controllers: the commands of recorded loops, under strict compilers and sanitizers."""

import re
import shutil
import subprocess

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.c_code import export_c, write_c
from jaxbeam.case.case import Run
from jaxbeam.control.feedback import Feedback
from jaxbeam.control.optimal.crossing_lqr import FiniteLQR
from jaxbeam.control.optimal.sampled_lqr import DiscreteLQR
from jaxbeam.control.optimal.scheduled_lqr import ScheduledLQR
from jaxbeam.control.output_feedback import OutputFeedback
from jaxbeam.control.scheduled_feedback import ScheduledFeedback

COMPILER = shutil.which("cc") or shutil.which("gcc")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")

STRICT = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic"]
SANITIZED = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g"]
PERIOD = 4e-3


def rig(controller, **changes):
    """Beam with two shakers, three sensors and a mass that crosses in 0.25 s."""
    parts = {
        "actuators": [jb.Shaker(0.2, 2000.0, 5.0, limits=(-4.0, 4.0)), jb.PointForce(0.45)],
        "sensors": [jb.Sensor(0.2), jb.Sensor(0.4), jb.Sensor(0.3, "velocity")],
        "loads": [jb.MovingMass(mass=0.4, speed=2.4, entry_time=0.02)],
        "run": Run(duration=0.4),
    }
    beam = jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2)
    return jb.Case(beam, controller=controller, **(parts | changes))


FILTERED = [jb.Sensor(0.2, filter=jb.Filter(40.0, 3), offset=1e-4), jb.Sensor(0.4, resolution=1e-5)]
CASES = {
    "feedback": rig(Feedback([2e3, 1e3], higher_gains=[[1e8, 2e8]], period=PERIOD)),
    "feedback-cubic": rig(Feedback([5e8, 1e8], power=3, period=PERIOD), sensors=FILTERED),
}


def program(name, case, tmp_path):
    program = export_c(case, name)
    write_c(program, tmp_path)
    return program


def run(folder, name, *options):
    """Exit status and output of the loop that checks the commands."""
    build = [COMPILER, *STRICT, *options, "-o", "check", f"{name}.c", f"{name}_check.c", "-lm"]
    subprocess.run(build, cwd=folder, check=True)
    return subprocess.run([folder / "check"], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("kind", CASES)
def test_program_gives_the_commands_of_the_loop(kind, tmp_path):
    name = kind.replace("-", "_")
    program = export_c(CASES[kind], name)
    write_c(program, tmp_path)
    checked = run(tmp_path, name, *SANITIZED)
    print(checked.stdout, checked.stderr, program.operations)
    assert checked.returncode == 0
