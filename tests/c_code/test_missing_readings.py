"""Programs in C with missing, late and impossible readings: as simulated, finite, within limits."""

import dataclasses
import functools
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.c_code import CProgram, export_c, write_c
from jaxbeam.c_code.program import samples_text
from jaxbeam.c_code.sampled_program import RecordedLoop
from jaxbeam.estimation.kalman import DIFFERENCE_STEP
from jaxbeam.fmi import ControllerSteps
from jaxbeam.model.sensor_signals import to_reading
from tests.c_code.cases import CASES, DESIGNED_TABLES, PERIOD
from tests.c_code.test_c_code import COMPILER, ROUNDING, SANITIZED, STRICT

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
KINDS = [*CASES, *DESIGNED_TABLES]
FAULTS = Path(__file__).with_name("faults.c")
# Laws that do not forget where readings are given and do not answer to commands: they add moves to
# the last command, or keep what they have identified.
REMEMBERING = re.compile("mpc|gpc|feedback-scheduled|family|nearest|lqr-scheduled")


def with_ranges(case: jb.Case) -> jb.Case:
    """The case with sensors that have a range, which no reading of the run leaves."""
    sensors = [dataclasses.replace(sensor, range=[-20.0, 20.0]) for sensor in case.sensors]
    return dataclasses.replace(case, sensors=tuple(sensors))


def lossy(case: jb.Case, late: float = 1e-3) -> jb.Case:
    """The case whose readings and commands are lost, or late by some time (s), at random."""
    sensors = [dataclasses.replace(one, dropout=0.1, jitter=late) for one in case.sensors]
    controller = dataclasses.replace(case.controller, dropout=0.05, jitter=late)
    return dataclasses.replace(case, sensors=tuple(sensors), controller=controller)


def overtaking(case: jb.Case) -> jb.Case:
    """The case whose commands come so late that newer ones overtake them."""
    return lossy(case, 1.5 * PERIOD)


def mostly_lost(case: jb.Case) -> jb.Case:
    """Half of the readings and a third of the commands are lost, the others up to 2 ms late."""
    sensors = [dataclasses.replace(one, dropout=0.5, jitter=2e-3) for one in case.sensors]
    controller = dataclasses.replace(case.controller, dropout=0.3, jitter=2e-3)
    run = dataclasses.replace(case.run, seed=3)
    return dataclasses.replace(case, sensors=tuple(sensors), controller=controller, run=run)


def first_lost(case: jb.Case) -> jb.Case:
    """The case whose first readings never come."""
    sensors = [dataclasses.replace(one, dropout=0.9) for one in case.sensors]
    return dataclasses.replace(case, sensors=tuple(sensors))


@functools.cache
def exported(kind: str, change=None) -> CProgram:
    case = (CASES | DESIGNED_TABLES)[kind]
    return export_c(case if change is None else change(case), "law")


def built(program: CProgram, folder: Path, *options) -> str:
    """What a program prints, compiled in a folder under the sanitizers."""
    write_c(program, folder)
    assert COMPILER is not None
    build = [COMPILER, *STRICT, *SANITIZED, f"-I{folder}", *options, "-o", "run", "-lm"]
    subprocess.run(map(str, build), cwd=folder, check=True)
    ended = subprocess.run([folder / "run"], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def largest_error(program: CProgram, folder: Path) -> float:
    """Largest error of the commands of a program by its own check, relative to the largest."""
    found = re.search(r"largest error (\S+) of it", built(program, folder, "law.c", "law_check.c"))
    assert found
    return float(found[1])


LATE = [(kind, overtaking) for kind in ("ppf", "compensation", "h-infinity")]
LATE += [("kalman-extended", mostly_lost), ("feedback-scheduled", mostly_lost)]
LATE += [(kind, first_lost) for kind in ("dlqr-kalman", "gpc", "lqr-inversion", "kalman-extended")]


@pytest.mark.parametrize(("kind", "change"), [*((kind, lossy) for kind in KINDS), *LATE])
def test_lossy_loops_have_the_commands_of_the_program(kind, change, tmp_path):
    """Readings and commands are lost and late in the loop; the program receives NaN."""
    program = exported(kind, change)
    assert program.files["law_samples.h"].count("NAN") > 2
    step = DIFFERENCE_STEP if kind == "kalman-extended" else 1.0  # of derivatives; rounding / step
    assert largest_error(program, tmp_path) < ROUNDING / step


def replayed(kind: str, program: CProgram, folder: Path, *options) -> tuple[float, float]:
    """Difference of the commands after faults, and the largest command, as `faults.c` prints."""
    limits = [actuator.command_limits() for actuator in (CASES | DESIGNED_TABLES)[kind].actuators]
    lowest, highest = (
        ",".join(str(float(pair[i])) if pair is not None else f"{sign}INFINITY" for pair in limits)
        for i, sign in enumerate("-+")
    )
    gated = ["-DGATED"] * ("law_gate(" in program.files["law.h"])
    sizes = re.findall(r"^    law_real \w+\[(\d+)\];", program.files["law.h"], re.M)
    ends = f"-DLOWEST={{{lowest}}}", f"-DHIGHEST={{{highest}}}", f"-DNUMBERS={sum(map(int, sizes))}"
    difference, largest = map(
        float, built(program, folder, *options, *gated, *ends, FAULTS).split()
    )
    return difference, largest


@pytest.mark.parametrize("kind", KINDS)
def test_programs_recover_from_faults(kind, tmp_path):
    """Missing and impossible readings in an eighth of the run leave no NaN, and no trace later."""
    options = "-DWILD=1e3", "-DROUNDS=200"
    difference, largest = replayed(kind, exported(kind, with_ranges), tmp_path, *options)
    assert largest > 0.1
    if not REMEMBERING.search(kind):
        assert difference <= 1e-6 * largest


@pytest.mark.parametrize(
    "kind",
    ["feedback-cubic", "lqr-inversion", "compensation-kalman", "gpc", "h-infinity", "mpc-soft"],
)
def test_units_and_programs_do_the_same_without_readings(kind, tmp_path):
    """The controller for co-simulation and the program in C, of the same faulty random readings."""
    case, program = CASES[kind], exported(kind)
    steps, random = ControllerSteps(case), np.random.default_rng(5)
    times = PERIOD * np.arange(60)
    ideal = np.cumsum(random.normal(size=(60, len(case.sensors))), axis=0) * 1e-4
    faults = random.choice([np.nan, np.inf], size=ideal.shape)
    readings = np.where(random.uniform(size=ideal.shape) < 0.3, faults, ideal)
    pairs = [zip(case.sensors, row, strict=True) for row in readings]
    sampled = [
        [to_reading(*one) if np.isfinite(one[1]) else one[1] for one in row] for row in pairs
    ]
    commands = []
    for t, row in zip(times, readings, strict=True):
        steps.step(t, row)
        commands.append(np.asarray(steps._memory.queue[0][:, 0]))
        steps.step(t + PERIOD / 2, row)  # commands with a delay begin
    loop = RecordedLoop(times, np.array(sampled), np.zeros((60, 0)), np.array(commands))
    text = samples_text("law", loop, np.zeros((60, 0)), [])
    program = program._replace(files=program.files | {"law_samples.h": text})
    assert np.max(np.abs(commands)) > 1e-3
    assert largest_error(program, tmp_path) < ROUNDING


@pytest.mark.parametrize("kind", KINDS)
def test_programs_survive_an_overflow(kind, tmp_path):
    """Readings of 1e29 from sensors without a range, whose squares no float can hold."""
    options = "-DLAW_REAL=float", "-DWILD=1e29", "-DROUNDS=1"
    replayed(kind, exported(kind), tmp_path, *options)
