"""Export of programs in C: the command, what is refused, files that exist, a check that fails."""

import dataclasses
import json
import re
import shutil
import subprocess
from typing import Any

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.controller import AbstractController, AbstractSampledLaw, ControlStep
from jaxbeam.cli import main
from jaxbeam.cli.commands.export import PROGRAM_FILES
from jaxbeam.control.feedback import Feedback
from jaxbeam.export import export_c, write_c
from jaxbeam.runtime.arrays import while_loop, xp
from tests.export.cases import CASES, PERIOD, rig

COMPILER = shutil.which("cc") or shutil.which("gcc")
FEEDFORWARD = CASES["feedforward"]


@pytest.fixture(scope="module")
def program():
    return export_c(FEEDFORWARD, "gates")


def test_command_writes_a_program_and_says_its_cost(program, tmp_path, capsys):
    jb.save_case(FEEDFORWARD, tmp_path / "case.toml")
    command = ["export", str(tmp_path / "case.toml"), "-o", str(tmp_path / "gates.c")]
    with pytest.raises(SystemExit) as ended:
        main([*command, "--json"])
    assert ended.value.code == 0
    report = json.loads(capsys.readouterr().out)
    assert report["operations_per_step"] == program.operations
    assert report["state_bytes"] == program.state_bytes
    assert report["files"] == [f"gates{ending}" for ending in PROGRAM_FILES]
    assert {path.name: path.read_text() for path in tmp_path.glob("gates*")} == program.files
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert ended.value.code == 1 and "gates.h exists" in capsys.readouterr().err


def test_header_states_cost_and_meaning(program):
    header = program.files["gates.h"]
    assert f"Cost of a step at worst: {program.operations} additions" in header
    assert f"{program.state_bytes} bytes of state, {program.constant_bytes} bytes" in header
    assert "void gates_gate(gates_state *s, int gate, gates_real t);" in header
    assert "readings of the sensors (3), in SI units" in header


@pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
def test_check_finds_a_wrong_constant(program, tmp_path):
    source, changes = re.subn(
        r"(values_0\[\] = \{\(real\)0.0, \(real\)5.0)", r"\g<1>2", program.files["gates.c"]
    )
    assert changes == 1
    write_c(program._replace(files=program.files | {"gates.c": source}), tmp_path)
    assert COMPILER is not None
    build = [COMPILER, "-std=c99", "-o", "check", "gates.c", "gates_check.c", "-lm"]
    subprocess.run(build, cwd=tmp_path, check=True)
    ended = subprocess.run([tmp_path / "check"], capture_output=True, text=True)
    assert ended.returncode == 1
    assert 1e-3 < float(ended.stdout.split("largest error ")[1].split()[0]) < 4e-3


def test_files_are_not_overwritten(program, tmp_path):
    (tmp_path / "gates_check.c").write_text("mine")
    with pytest.raises(FileExistsError, match="gates_check.c exists already"):
        write_c(program, tmp_path)
    assert not (tmp_path / "gates.c").exists()


class Endless(AbstractController):
    """Controller whose law may turn for ever."""

    def design_law(self, plant):
        return EndlessLaw()


class EndlessLaw(AbstractSampledLaw):
    """Halves the reading until it is small."""

    def step(self, state, measurement, t):
        halved = while_loop(lambda y: y > 1e-9, lambda y: y / 2, measurement.readings[0])
        return ControlStep(xp.stack([halved, halved]), state)


class LagLaw(AbstractSampledLaw):
    """u = -(share y + (1 - share) last y), the share a number by itself."""

    share: Any

    def initial_state(self):
        return np.zeros(())

    def step(self, state, measurement, t):
        reading = measurement.readings[0]
        wanted = -1e4 * (self.share * reading + (1 - self.share) * state)
        return ControlStep(xp.stack([wanted, 0 * wanted]), reading)


class Lag(AbstractController):
    """Controller with a `LagLaw`."""

    def design_law(self, plant):
        return LagLaw(np.asarray(0.75))


@pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
def test_a_law_of_ones_own_needs_no_code_in_c(tmp_path):
    write_c(export_c(rig(Lag(period=PERIOD)), "law"), tmp_path)
    assert COMPILER is not None
    build = [COMPILER, "-std=c99", "-Wall", "-Werror", "-o", "check", "law.c", "law_check.c", "-lm"]
    subprocess.run(build, cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "check"], capture_output=True).returncode == 0


@pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
def test_fast_math_is_refused(program, tmp_path):
    write_c(program, tmp_path)
    assert COMPILER is not None
    build = [COMPILER, "-std=c99", "-ffast-math", "-c", "gates.c"]
    ended = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode != 0 and "missing readings are NaN" in ended.stderr


def test_header_says_what_happens_without_a_reading():
    said = {
        "dlqr-kalman": "The estimate is predicted by the model, and not corrected by it.",
        "lqr-inversion": "The estimate stays while a deflection is missing.",
        "feedback-scheduled": "Samples at which a deflection is missing do not identify the load.",
        "feedforward": "No reading is used.",
    }
    for kind, sentence in said.items():
        header = " ".join(export_c(CASES[kind], "law").files["law.h"].split())
        assert sentence in header and "outside the range of its sensor, is missing" in header


REFUSED = {
    "controller is missing": dataclasses.replace(FEEDFORWARD, controller=None),
    "controller.period is missing": rig(Feedback([1.0, 1.0])),
    "kind 'Endless' cannot be exported as C: there is no C for a loop without a largest": rig(
        Endless(period=PERIOD)
    ),
    "the closed loop diverges": rig(jb.OutputFeedback([[0, 0, 1e6], [0, 0, 1e6]], period=PERIOD)),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_cannot_be_exported(message):
    with pytest.raises(ValueError, match=message):
        export_c(REFUSED[message], "law")


@pytest.mark.parametrize("name", ["my-law", "2laws", "int main"])
def test_names_are_those_of_c(name):
    with pytest.raises(ValueError, match="cannot be the name of functions in C"):
        export_c(FEEDFORWARD, name)
