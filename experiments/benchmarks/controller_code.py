"""C of every kind of controller: operations and memory of a step, and how far its commands agree.

    python -m experiments.benchmarks.controller_code [--only TEXT]

The laws of `controller_steps` on its rig, exported, compiled and run over the recorded loop, as by
the check that is written with each: largest errors of the commands over the largest command, in
`double`, in `float`, and in `double` over a loop that has lost 5 % of its readings. Operations are
those of a step at worst; bytes those of the state, of the constants and of the stack. Needs `cc`.
"""

import dataclasses
import re
import subprocess
import tempfile
import warnings
from pathlib import Path
from typing import NamedTuple

import jaxbeam as jb
from experiments.benchmarks.common import parser, print_row, print_table
from experiments.benchmarks.controller_steps import CONTROLLERS, MODES, PERIOD, patch_case
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import kinds
from jaxbeam.control.sampled_lqr import SamplingWarning
from jaxbeam.export import CProgram, export_c, write_c
from jaxbeam.simulation.simulate import ContactLossWarning

LOST = 0.05  # of the readings
COMPILER = "cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"
OTHERS = {
    "internal-model-scheduled": jb.ScheduledInternalModel(period=PERIOD),
    "h-infinity": jb.HInfinity(
        output_size=4e-4,
        command_size=4.0,
        force_size=4.0,
        noise_size=1e-3,
        corner=20.0,
        period=PERIOD,
    ),
    "mpc-scenario": jb.ScenarioMPC(
        horizon=6, moves=4, move_weight=1e-11, stiffness_factors=[0.8, 1.2], period=PERIOD
    ),
}
DAMPED = jb.Case(
    jb.Beam(0.6, 13.211, 0.812, 0.03, modes=MODES),
    actuators=[jb.PointForce(0.3)],
    sensors=[jb.Sensor(0.3), jb.Sensor(0.3, "velocity")],
    loads=[jb.MovingMass(mass=0.509, speed=1.0, entry_time=0.2)],
    controller=jb.SemiActive(
        min_damping=0.5, max_damping=40.0, desired=jb.Feedback([2e3]), period=PERIOD
    ),
    run=jb.Run(1.0, sample_rate=1 / PERIOD),
)
CASES = {name: patch_case(law) for name, law in (CONTROLLERS | OTHERS).items()}
CASES["semi-active"] = DAMPED


class CodeFigures(NamedTuple):
    """Cost of the C of a law, and the largest errors of its commands over the largest one."""

    operations: int
    state_bytes: int
    constant_bytes: int
    stack_bytes: int
    double_error: float
    float_error: float
    lossy_error: float


def figures(case: jb.Case) -> CodeFigures:
    """Figures of the C of the controller of a case. Raises RuntimeError if a check ends early."""
    lossy = dataclasses.replace(
        case, sensors=[dataclasses.replace(one, dropout=LOST) for one in case.sensors]
    )
    with warnings.catch_warnings():
        for kind in (ContactLossWarning, SamplingWarning):
            warnings.simplefilter("ignore", kind)
        program, of_lossy = (export_c(one, "law") for one in (case, lossy))
    stack = re.search(r"(\d+) bytes of intermediate results", program.files["law.h"])
    return CodeFigures(
        program.operations,
        program.state_bytes,
        program.constant_bytes,
        int(stack[1]) if stack else 0,
        _error(program),
        _error(program, "-DLAW_REAL=float"),
        _error(of_lossy),
    )


def _error(program: CProgram, *options: str) -> float:
    """Largest error of the commands of a program, as its own check prints it."""
    with tempfile.TemporaryDirectory() as folder:
        write_c(program, folder)
        build = [*COMPILER, *options, "-o", "check", "law.c", "law_check.c", "-lm"]
        subprocess.run(build, cwd=folder, check=True)
        ended = subprocess.run([Path(folder) / "check"], capture_output=True, text=True)
    found = re.search(r"largest error (\S+) of it", ended.stdout)
    if not found:
        raise RuntimeError(f"the check of an exported program ended early: {ended.stderr}")
    return float(found[1])


def main() -> None:
    """Print the table, and the kinds of controllers that it lacks."""
    options = parser(__doc__)
    options.add_argument("--only", default="", help="laws whose names contain this")
    only = options.parse_args().only
    classes = {type(case.controller) for case in CASES.values()}
    lacking = [kind for kind, each in kinds(AbstractController).items() if each not in classes]
    if lacking:
        print(f"no example is listed here: {', '.join(lacking)}\n")
    memory = "state (bytes)", "constants (bytes)", "stack (bytes)"
    print_table(("law", "operations", *memory, "double", "float", f"{LOST:.0%} lost"))
    for name, case in CASES.items():
        if only in name:
            found = figures(case)
            errors = (f"{error:.0e}" for error in found[4:])
            print_row((name, *(f"{number:d}" for number in found[:4]), *errors))


if __name__ == "__main__":
    main()
