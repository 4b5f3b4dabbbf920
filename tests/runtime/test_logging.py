"""What the logger "jaxbeam" says of decisions: cache, compiler, and who takes the steps of a sweep.

It is quiet unless a program asks for it.
"""

import logging
import subprocess
import sys

import jaxbeam as jb
from jaxbeam.runtime import compile_cache, native_library

CASE = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=1),
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingForce(force=1.0, speed=2.0)],
)


def test_a_sweep_says_who_takes_its_steps(caplog):
    with caplog.at_level(logging.INFO, "jaxbeam"):
        jb.sweep(CASE, {"loads.0.speed": [1.0, 2.0]}, progress=False)
    said = [record.getMessage() for record in caplog.records if record.name.startswith("jaxbeam.")]
    assert [text for text in said if text.startswith("sweep in 1 blocks by ")]


def test_a_missing_compiler_and_one_that_fails_are_told(caplog, monkeypatch):
    library = native_library.Library((), (), (), "this is no C")
    with caplog.at_level(logging.INFO, "jaxbeam"):
        monkeypatch.setattr(native_library, "find_compiler", lambda: None)
        assert not library.can_be_built()
        monkeypatch.setattr(native_library, "find_compiler", lambda: "no-such-compiler")
        with library.built_meanwhile():
            pass
    missing, failed = caplog.messages
    assert missing == "C code not used: there is no C compiler"
    assert failed.startswith("C code not used: the C compiler no-such-compiler cannot be run")


def test_the_folder_of_the_cache_is_told(caplog, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setattr(compile_cache.jax.config, "update", lambda name, value: None)
    monkeypatch.setenv(compile_cache.SIZE_VARIABLE, "8")
    monkeypatch.setattr(compile_cache, "max_bytes", lambda: 8 << 20)
    with caplog.at_level(logging.INFO, "jaxbeam"):
        compile_cache.switch_on()
    assert caplog.messages[0].startswith("compile cache in ")


def test_nothing_is_logged_by_default():
    program = (
        "import jaxbeam as jb, logging; logging.getLogger('jaxbeam.sweeps').info('a decision')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
