"""C code of controllers: the commands of recorded loops, under strict compilers and sanitizers."""

import shutil
import subprocess

import pytest

from jaxbeam.c_code import export_c, write_c
from tests.c_code.cases import CASES, DESIGNED_TABLES

COMPILER = shutil.which("cc") or shutil.which("gcc")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")

STRICT = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic"]
SANITIZED = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g"]
ALL = CASES | DESIGNED_TABLES
SLOW = [pytest.param(kind, marks=pytest.mark.slow) for kind in DESIGNED_TABLES]


def run(folder, name, *options):
    """Exit status and output of the loop that checks the commands."""
    build = [COMPILER, *STRICT, *options, "-o", "check", f"{name}.c", f"{name}_check.c", "-lm"]
    subprocess.run(build, cwd=folder, check=True)
    return subprocess.run([folder / "check"], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("kind", [*CASES, *SLOW])
def test_program_gives_the_commands_of_the_loop(kind, tmp_path):
    name = kind.replace("-", "_")
    program = export_c(ALL[kind], name)
    write_c(program, tmp_path)
    checked = run(tmp_path, name, *SANITIZED)
    print(checked.stdout, checked.stderr, program.operations)
    assert checked.returncode == 0
