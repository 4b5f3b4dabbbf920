"""C code of controllers: the commands of recorded loops, under strict compilers and sanitizers.

Programs in C with missing, late and impossible readings: as simulated, finite, within limits.

Programs in C of laws with other numbers of readings and actuators than the cases have.
"""

import dataclasses
import functools
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.fields import axis_names
from jaxbeam.cli import main
from jaxbeam.control.estimation.kalman import DIFFERENCE_STEP
from jaxbeam.export import CProgram, export_c, write_c
from jaxbeam.export.c_program import samples_text
from jaxbeam.export.c_sampled_program import RecordedLoop
from jaxbeam.export.fmi import ControllerSteps
from jaxbeam.model.sensor_signals import to_reading
from tests.export.cases import CASES, DESIGNED_TABLES, PERIOD

COMPILER, CPP_COMPILER = shutil.which("cc") or shutil.which("gcc"), shutil.which("c++")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")

STRICT = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic"]
SANITIZED = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
ALL = CASES | DESIGNED_TABLES
KINDS = [*CASES, *DESIGNED_TABLES]
ROUNDING, SINGLE_ROUNDING = 1e-12, 1e-2  # of the largest command
# Derivatives by differences over 1e-4 of a number, which multiply rounding by as much.
BY_DIFFERENCES = {"kalman-extended": 1e-10}
MIN_OPERATIONS_SHARE = 0.3  # of the stated operations that a loop without a quadratic program takes


@functools.cache
def exported(kind: str, change=None) -> CProgram:
    """Program of the case of a kind, changed by a function of it."""
    return export_c(ALL[kind] if change is None else change(ALL[kind]), "law")


def checked(kind: str, folder: Path, *options: str) -> tuple[float, int]:
    """Error of the commands relative to the largest, and bytes of the state, as a check prints."""
    write_c(exported(kind), folder)
    assert COMPILER is not None
    build = [COMPILER, *STRICT, *options, "-o", "check", "law.c", "law_check.c", "-lm"]
    subprocess.run(build, cwd=folder, check=True)
    ended = subprocess.run([folder / "check"], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    found = re.search(
        r"largest command (\S+), largest error (\S+) of it, (\d+) bytes", ended.stdout
    )
    assert found and float(found[1]) > 0.1
    return float(found[2]), int(found[3])


@pytest.mark.parametrize("kind", KINDS)
def test_program_gives_the_commands_of_the_loop(kind, tmp_path):
    """To rounding, without warnings and memory errors; the memory is stated."""
    error, state_bytes = checked(kind, tmp_path, *SANITIZED)
    assert error < BY_DIFFERENCES.get(kind, ROUNDING)
    assert state_bytes == exported(kind).state_bytes


@pytest.mark.parametrize("kind", KINDS)
def test_program_in_single_precision(kind, tmp_path):
    """To its rounding; nothing is computed in double precision, so that no library of it is needed.

    The compilers warn of each number that is converted.
    """
    in_single = ["-DLAW_REAL=float", "-Wdouble-promotion", "-Wfloat-conversion"]
    error, state_bytes = checked(kind, tmp_path, *in_single, "-O0")  # it is run once
    assert 0 < error < SINGLE_ROUNDING
    assert state_bytes <= exported(kind).state_bytes


@pytest.mark.skipif(CPP_COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("kind", KINDS)
def test_operations_at_worst_are_stated(kind, tmp_path):
    """Counted by a type of numbers that counts its operations, in C++."""
    program = exported(kind)
    write_c(program, tmp_path)
    gated = ["-DGATED"] * ("law_gate(" in program.files["law.h"])
    counter = Path(__file__).with_name("count_operations.cpp")
    assert CPP_COMPILER is not None
    build = [CPP_COMPILER, "-O0", f"-I{tmp_path}", *gated, "-o", tmp_path / "count", counter]
    subprocess.run(build, check=True)
    run = subprocess.run([tmp_path / "count"], capture_output=True, text=True, check=True)
    counted = int(run.stdout)
    assert counted <= program.operations
    if "numerics/qp" not in program.files["law.c"]:
        assert counted >= MIN_OPERATIONS_SHARE * program.operations


CONVERSIONS = ["-Wconversion", "-Wsign-conversion", "-Wshadow", "-Wdouble-promotion"]
FORBIDDEN = (
    r"\b(goto|while|do|malloc|calloc|realloc|free|va_list|setjmp|longjmp)\b|\(\s*\*\s*\w+\s*\)\s*\("
)
FUNCTION = re.compile(r"^(?:static )?(?:void|real|int) (\w+)\([^;{]*\)\n\{\n(.*?)^\}", re.M | re.S)


@pytest.mark.parametrize("kind", KINDS)
def test_programs_keep_the_rules_that_the_page_states(kind, tmp_path):
    write_c(exported(kind), tmp_path)
    build = [COMPILER, *STRICT, *CONVERSIONS, "-O0", "-c", "-o", "law.o", "law.c"]
    subprocess.run(build, cwd=tmp_path, check=True)
    code = re.sub(r"/\*.*?\*/", "", exported(kind).files["law.c"], flags=re.S)
    assert not re.search(FORBIDDEN, code)
    bodies = dict(FUNCTION.findall(code))
    assert {"law_step", "law_reset"} <= set(bodies) and "return" not in bodies["law_step"]
    # Outside functions nothing but constants, and a function calls those before it alone.
    outside = FUNCTION.sub("", code)
    assert not re.search(r"^(?!.*\bconst\b)(?:static )?(?:real|int) \w+(?:\[| =|;)", outside, re.M)
    for i, body in enumerate(bodies.values()):
        later = [name for name in list(bodies)[i:] if re.search(rf"\b{name}\(", body)]
        assert not later


# The example of docs/export.md: the program that it writes repeats the simulated commands.

PAGE = (Path(__file__).parents[2] / "docs" / "export.md").read_text(encoding="utf-8")


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_example_runs_and_its_commands_are_equal(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    case, command, check = (
        re.findall(rf"```{re.escape(kind)}\n(.*?)```", PAGE, re.S)[0]
        for kind in ("{write} gates.toml", "{run-command}", "{run}")
    )
    Path("gates.toml").write_text(case)
    with pytest.raises(SystemExit) as ended:
        main(command.split()[1:])
    assert ended.value.code == 0 and "gates.c" in capsys.readouterr().out
    exec(check, {})  # fails if the check does
    assert capsys.readouterr().out.strip()


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
    limits = [actuator.command_limits() for actuator in ALL[kind].actuators]
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


MORE_SENSORS = [jb.Sensor(0.3, "velocity"), jb.Sensor(0.1)]
MORE_ACTUATORS = [jb.PointForce(0.3), jb.PointForce(0.45)]
SIZES = [
    ("feedback", 2, 1),
    ("output-feedback", 1, 3),
    ("lqr-inversion", 1, 1),
    ("lqr-inversion", 2, 3),
    ("dlqr-kalman", 1, 3),
    ("mpc", 2, 2),  # unstable by itself: only the loop is stable
    ("gpc", 1, 3),
    ("gpc-adaptive", 1, 1),
    ("gpc-adaptive", 1, 2),
    ("gpc-adaptive", 3, 1),
    ("h-infinity", 1, 2),
]


def resized(case: jb.Case, sensors: int, actuators: int) -> jb.Case:
    """The case with fewer or more sensors and actuators, and the first entries of its settings."""
    own = (*case.sensors, *MORE_SENSORS)[:sensors], (*case.actuators, *MORE_ACTUATORS)[:actuators]
    states = 2 * case.beam.modes + sum(a.attachment().state_matrix.shape[0] for a in own[1])
    sizes = {"actuator": actuators, "sensor": sensors, "output": sensors, "state": states}
    changes = {}
    for field in dataclasses.fields(case.controller):
        value = getattr(case.controller, field.name)
        if "unit" not in field.metadata or value is None or not np.ndim(value):
            continue
        for axis, name in enumerate(axis_names(field).split()):
            count = sizes.get(name.lstrip("*"), np.shape(value)[axis])
            value = np.take(value, np.arange(count) % np.shape(value)[axis], axis)
        changes[field.name] = value
    controller = dataclasses.replace(case.controller, **changes)
    return dataclasses.replace(case, sensors=own[0], actuators=own[1], controller=controller)


@pytest.mark.parametrize(("kind", "sensors", "actuators"), SIZES)
def test_other_numbers_of_readings_and_actuators(kind, sensors, actuators, tmp_path):
    program = export_c(resized(CASES[kind], sensors, actuators), "law")
    assert largest_error(program, tmp_path) < ROUNDING


def test_adaptive_law_of_one_reading_that_never_stops_to_identify(tmp_path):
    """The covariance of its coefficients becomes small against that of the start."""
    case = jb.Case(
        jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
        actuators=[jb.PointForce(0.3, limits=[-4.0, 4.0])],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.4, speed=4.0, entry_time=0.2)],
        controller=jb.AdaptiveGPC(8, 2, 1e-9, period=PERIOD),
        run=jb.Run(1.0),
    )
    assert largest_error(export_c(case, "law"), tmp_path) < ROUNDING
