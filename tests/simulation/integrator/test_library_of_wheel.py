"""The C integrator that the build hook puts into a wheel, here compiled by the compiler at hand."""

import ctypes
import dataclasses
import importlib.util
import logging
import os
import pathlib
import platform
import shutil
import subprocess
import sys
import types

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.runtime import native_library
from jaxbeam.simulation.integrator import native_peaks
from tests.modules import ROOT

COMPILER, PATH = native_library.find_compiler(), os.environ["PATH"]
pytestmark = pytest.mark.skipif(
    COMPILER is None or platform.machine() != "x86_64" or sys.platform != "linux",
    reason="no C compiler for Linux on x86 here",
)
CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, modes=3),
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.1, speed=2.0)],
    actuators=[jb.PointForce(0.2)],
    run=jb.Run(0.3),
)
OVER = {"loads.0.mass": np.linspace(0.05, 0.5, 5), "loads.0.speed": [1.0, 2.0, 4.0]}


@pytest.fixture(scope="module")
def hook():
    """The module of the build hook; its base class is of hatchling, which only builds install."""
    name = "hatchling.builders.hooks.plugin.interface"
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, name, types.SimpleNamespace(BuildHookInterface=object))
        spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def wheel(hook, tmp_path_factory):
    """Folder of the C files as a wheel has them, with libraries of the sources of this checkout."""
    folder = tmp_path_factory.mktemp("wheel") / "native"
    shutil.copytree(native_library.C_FOLDER, folder)
    (folder / "compiled").mkdir()
    run = subprocess.run

    def compile_here(command, **options):
        cpu = next(word for word in command if word.startswith("-mcpu=")).partition("=")[2]
        # -O1 compiles in half the time
        flags = [*hook.FLAGS[:-1], "-O1", "-fPIC", f"-march={cpu.replace('_', '-')}"]
        run([COMPILER, *flags, *command[command.index(hook.FLAGS[-1]) + 1 :]], **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(subprocess, "run", compile_here)
        paths = hook.compile_for(hook.PLATFORMS["linux-x86_64"], folder / "compiled")
    assert [pathlib.Path(path).parent.name for path in paths.values()] == ["compiled"] * 2
    return folder


@pytest.fixture
def installed(wheel, tmp_path, monkeypatch):
    """This process as one with the wheel, without a compiler and with an empty cache folder."""
    monkeypatch.setattr(native_library, "C_FOLDER", wheel)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    forget()
    yield
    forget()


@pytest.fixture
def compiler(monkeypatch):
    """A function that lets this process have a compiler."""

    def give():
        monkeypatch.setenv("PATH", PATH)
        monkeypatch.setenv("CC", COMPILER)
        forget()

    return give


def forget():
    """Let the next call load libraries again."""
    for cached in (native_library._load, native_library._in_wheel, native_library._fingerprint):
        cached.cache_clear()


def test_sweeps_take_the_library_of_the_wheel(installed, compiler, tmp_path):
    """With a compiler, which compiles nothing, and without: the same to the bit."""
    assert native_library.find_compiler() is None
    assert native_peaks.chosen_for(CASE, 1)
    without = jb.sweep(CASE, OVER, progress=False).peak_deflection
    compiler()
    beside = jb.sweep(CASE, OVER, progress=False).peak_deflection
    assert not list(tmp_path.rglob("native-*"))
    assert np.array_equal(without, beside)
    native_peaks.LIBRARY.build()
    forget()
    compiled = jb.sweep(CASE, OVER, progress=False).peak_deflection
    assert_allclose(compiled, without, rtol=1e-11)
    native_peaks.LIBRARY.remove()
    assert not native_peaks.available()  # as `jaxbeam native --remove` says
    plain = jb.sweep(CASE, OVER, progress=False).peak_deflection
    assert np.any(plain != without)
    assert_allclose(plain, without, rtol=1e-6)


def test_laws_are_compiled_for_the_registers_of_the_wheel(installed, compiler, monkeypatch):
    monkeypatch.setattr(native_peaks, "MIN_RUNS_OF_LOOPS", 1)
    controlled = dataclasses.replace(CASE, controller=jb.Feedback(gains=[100.0], period=0.002))
    without = jb.sweep(controlled, OVER, progress=False).peak_deflection
    compiler()
    commands, run = [], native_library._run_compiler
    monkeypatch.setattr(
        native_library, "_run_compiler", lambda *words: (commands.append(words[1]), run(*words))
    )
    found = jb.sweep(controlled, OVER, progress=False).peak_deflection
    (command,) = commands
    assert f"-march={native_peaks.LIBRARY.loaded_architecture()}" in command
    assert_allclose(found, without, rtol=1e-11)
    assert np.any(found != without)


@pytest.mark.parametrize(("newer", "expected"), [(0, "x86-64-v2"), (1, "x86-64-v3")])
def test_the_processor_chooses(installed, newer, expected, monkeypatch):
    fake = types.SimpleNamespace(runs_x86_64_v3=lambda: newer)
    monkeypatch.setattr(native_library, "library_of_wheel", lambda path: fake)
    assert native_peaks.LIBRARY.loaded_architecture() == expected


def test_the_instructions_of_this_processor(wheel):
    flags = pathlib.Path("/proc/cpuinfo").read_text().partition("flags")[2].partition("\n")[0]
    wanted = {"fma", "movbe", "avx", "f16c", "bmi1", "avx2", "bmi2", "abm", "xsave"}
    for path in (wheel / "compiled").iterdir():
        assert ctypes.CDLL(str(path)).runs_x86_64_v3() == (wanted <= set(flags.split()))


def test_a_library_that_does_not_load_is_told_and_left(installed, monkeypatch, tmp_path, caplog):
    folder = tmp_path / "native"
    shutil.copytree(native_library.C_FOLDER, folder)
    for path in (folder / "compiled").iterdir():
        path.write_bytes(b"of another machine")
    monkeypatch.setattr(native_library, "C_FOLDER", folder)
    with caplog.at_level(logging.INFO, "jaxbeam"):
        assert not native_peaks.available()
    assert "C code of the wheel not used: " in caplog.text


def test_changed_sources_are_compiled(installed, compiler, monkeypatch, tmp_path):
    folder = tmp_path / "native"
    shutil.copytree(native_library.C_FOLDER, folder)
    monkeypatch.setattr(native_library, "C_FOLDER", folder)
    compiler()
    assert native_peaks.available() and not native_peaks.LIBRARY.can_be_built()
    (folder / "contact.c").write_text((folder / "contact.c").read_text() + "/* changed */\n")
    forget()
    assert not native_peaks.available() and native_peaks.LIBRARY.can_be_built()
