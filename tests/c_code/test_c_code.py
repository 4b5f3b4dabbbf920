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
from jaxbeam.control.load_identification import LoadIdentification
from jaxbeam.control.optimal.crossing_lqr import FiniteLQR
from jaxbeam.control.optimal.sampled_lqr import DiscreteLQR
from jaxbeam.control.optimal.scheduled_lqr import ScheduledLQR
from jaxbeam.control.output_feedback import OutputFeedback
from jaxbeam.control.prescribed import Prescribed
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
TWO_LOADS = [
    jb.MovingMass(mass=0.4, speed=2.4, entry_time=0.02),
    jb.MovingMass(mass=0.2, speed=3.0, entry_time=0.1),
]
CASES = {
    "feedback": rig(Feedback([2e3, 1e3], higher_gains=[[1e8, 2e8]], period=PERIOD)),
    "feedback-cubic": rig(Feedback([5e8, 1e8], power=3, period=PERIOD), sensors=FILTERED),
    "output-feedback": rig(
        OutputFeedback([[2e3, 0.0, 5.0], [0.0, -1e3, 1.0]], period=PERIOD, delay=PERIOD)
    ),
    "pd": rig(jb.PD([2e3, 1e3], rate_gains=[10.0, 5.0], lag=1e-2, period=PERIOD)),
    "lead": rig(jb.Lead([2e3, 1e3], zero=5.0, pole=[20.0, 30.0], period=PERIOD)),
    "ppf": rig(
        jb.PositivePositionFeedback([1e3, 1e3], 8.0, damping_ratio=0.3, period=PERIOD, delay=1e-3)
    ),
    "prescribed": rig(
        Prescribed(
            [0.1, 0.2],
            amplitudes=[[1.0, 2.0], [0.5, 0.0]],
            frequencies=[3.0, 11.0],
            phases=[[0.0, 1.0], [2.0, 0.0]],
            times=[0.05, 0.1, 0.3],
            values=[[0.0, 1.0, -1.0], [2.0, 0.0, 1.0]],
            period=PERIOD,
        )
    ),
    "feedforward": rig(
        jb.Feedforward(
            [-0.05, 0.05],
            shares=[0.0, 0.3, 1.0],
            values=[[0.0, 5.0, 0.0], [1.0, 2.0, 3.0]],
            lead=2e-3,
            period=PERIOD,
            resolution=1e-2,
        ),
        loads=TWO_LOADS,
    ),
    "internal-model": rig(
        jb.InternalModel(
            [-1e-3, 0.0, 1e-3],
            values=[[4.0, 0.0, -4.0], [3.0, 0.0, -3.0]],
            notches=[30.0, 60.0],
            period=PERIOD,
        ),
        sensors=FILTERED,
    ),
    "feedback-scheduled": rig(
        ScheduledFeedback(
            [0.2, 0.5],
            [[1e3, 2e3], [1e3, 3e3]],
            load_identification=LoadIdentification(gates=[-0.05, 0.05]),
            period=PERIOD,
        )
    ),
    "feedback-stepped": rig(
        ScheduledFeedback(
            [0.2, 0.3, 0.5],
            [[1e8, 2e8, 3e8], [1e8, 3e8, 3e8]],
            power=3,
            between="stepped",
            load_identification=LoadIdentification(threshold=2e-5),
            period=PERIOD,
        )
    ),
}


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
