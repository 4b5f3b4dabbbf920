"""C code of controllers: the commands of recorded loops, under strict compilers and sanitizers."""

import functools
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from jaxbeam.c_code import CProgram, export_c, write_c
from jaxbeam.cli import main
from tests.c_code.cases import CASES, DESIGNED_TABLES

COMPILER, CPP_COMPILER = shutil.which("cc") or shutil.which("gcc"), shutil.which("c++")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")

STRICT = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic"]
SANITIZED = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
ALL = CASES | DESIGNED_TABLES
KINDS = [*CASES, *DESIGNED_TABLES]
ROUNDING, SINGLE_ROUNDING = 1e-12, 1e-2  # of the largest command
# Derivatives by differences over 1e-4 of a number, which multiply rounding by as much.
BY_DIFFERENCES = {"kalman-extended": 1e-10}
MIN_OPERATIONS_SHARE = 0.3  # of the stated operations that a loop without a quadratic program takes


@functools.cache
def exported(kind: str) -> CProgram:
    return export_c(ALL[kind], "law")


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


@needs_compiler
@pytest.mark.parametrize("kind", KINDS)
def test_program_gives_the_commands_of_the_loop(kind, tmp_path):
    """To rounding, without warnings and memory errors; the memory is stated."""
    error, state_bytes = checked(kind, tmp_path, *SANITIZED)
    assert error < BY_DIFFERENCES.get(kind, ROUNDING)
    assert state_bytes == exported(kind).state_bytes


@needs_compiler
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


@needs_compiler
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
