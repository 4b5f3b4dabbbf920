"""Compiled functions, alone and within others, and functions whose latest results are kept."""

import dataclasses
import logging
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.runtime import cache_folder, compiling, native_library
from jaxbeam.runtime.arrays import fori_loop, xp
from jaxbeam.runtime.compiling import compiled, compiled_if_traced
from jaxbeam.runtime.memory import KEPT_RESULTS, remembered

POINTS = np.array([0.1, 0.7, 2.0])


@compiled
def wave(x, power: int = 1):
    return jnp.sin(x) ** power


@pytest.mark.parametrize(
    ("transformed", "expected"),
    [
        (lambda x: wave(x, 3), lambda x: np.sin(x) ** 3),
        (jax.vmap(wave), np.sin),
        (jax.vmap(jax.grad(wave)), np.cos),
        (jax.jacfwd(wave), lambda x: np.diag(np.cos(x))),
        (jax.jit(lambda x: wave(x) + wave(0.5)), lambda x: np.sin(x) + np.sin(0.5)),
        (jax.jit(lambda x: x * jax.grad(wave)(0.5)), lambda x: x * np.cos(0.5)),
    ],
)
def test_compiled_functions_can_be_transformed(transformed, expected):
    """JAX refuses compiler options within another function: there they are left out."""
    assert_allclose(transformed(POINTS), expected(POINTS), rtol=1e-14)


@compiled
def halves(x, words: str):
    return {"half": x[: x.shape[0] // 2], "words": words, "count": x.shape[0], "none": None}


def test_template_has_the_structure_and_shapes_of_the_result():
    expected, result = halves.template(POINTS[:2], "as given"), halves(POINTS[:2], "as given")
    assert jax.tree.structure(expected) == jax.tree.structure(result)
    assert_allclose(result["half"], POINTS[:1])
    assert (
        (expected["words"], expected["count"])
        == (result["words"], result["count"])
        == ("as given", 2)
    )
    assert expected["half"].shape == (1,) and expected["half"].dtype == result["half"].dtype


def test_precompiled_functions_are_not_traced_again():
    traced = []

    @compiled
    def counted(x):
        traced.append(x.shape)
        return 2 * x

    for _ in range(3):
        counted.precompile(POINTS)()
        assert_allclose(counted(POINTS), 2 * POINTS)
    counted.precompile(POINTS[:2])()
    assert traced == [(3,), (2,)]
    compiling.clear_caches()
    counted.precompile(POINTS)()
    assert traced == [(3,), (2,), (3,)]


def test_unknown_options_are_left_out(monkeypatch):
    known = {"xla_backend_optimization_level": 1}
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(compiling, "XLA_OPTIONS", {"xla_no_such_setting": True, **known})
    compiling._supported_options.cache_clear()
    try:
        assert compiling.xla_options() == known
        assert_allclose(compiled(jnp.cos)(0.5), np.cos(0.5), rtol=1e-14)
    finally:
        compiling._supported_options.cache_clear()


@compiled_if_traced
def decay(x):
    return fori_loop(0, 20, lambda _, y: y * xp.cos(x), xp.ones(()))


def test_derivatives_are_computed_in_numpy_until_that_has_cost_a_compilation(monkeypatch):
    programs, program_of = [], compiling._program_of

    def noted(*args):
        programs.append(program_of(*args))
        return programs[-1]

    monkeypatch.setattr(compiling, "_program_of", noted)
    expected = -20 * np.cos(0.4) ** 19 * np.sin(0.4)
    assert_allclose(jax.grad(decay)(0.4), expected, rtol=1e-12)
    program = programs[-1]
    assert program.jitted._cache_size() == 0
    for _ in range(int(program.price / program.cost)):
        assert_allclose(jax.grad(decay)(0.4), expected, rtol=1e-12)
    assert programs[-1] is program
    assert program.jitted._cache_size() == 1


@pytest.mark.parametrize(
    ("transformed", "x"),
    [
        (jax.grad(jax.grad(decay)), 0.4),
        (jax.vmap(decay), np.array([0.4, 0.7])),
        (jax.vmap(jax.grad(decay)), np.array([0.4, 0.7])),
        (jax.hessian(lambda x: decay(x[0]) * decay(x[1])), np.array([0.4, 0.7])),
    ],
)
def test_transformations_in_numpy_are_those_of_xla(transformed, x):
    assert_allclose(transformed(x), jax.jit(transformed)(x), rtol=1e-12)


# LAPACK has one thread, whether NumPy was imported before or after; a setting of users stays.

COUNT = """
import threadpoolctl
print({library["num_threads"] for library in threadpoolctl.threadpool_info()})
"""


def available_cores() -> int:
    """Number of cores that this process may use; a system that binds none to processes has all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@pytest.mark.parametrize(
    ("lines", "setting", "threads"),
    [
        ("import numpy, jaxbeam", None, "{1}"),
        ("import numpy, tuning", None, "{1}"),
        ("import jaxbeam, numpy", None, "{1}"),
        ("import numpy, jaxbeam", "2", "{2}"),
    ],
)
def test_threads_of_lapack(lines, setting, threads):
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    if setting is not None:
        environment["OPENBLAS_NUM_THREADS"] = setting
    printed = subprocess.run(
        [sys.executable, "-c", lines + COUNT], env=environment, capture_output=True, check=True
    ).stdout
    if printed == b"set()\n":
        pytest.skip("NumPy was built without a library whose threads are known")
    if available_cores() > 1 or setting is None:
        assert printed.decode().strip() == threads


# What the logger "jaxbeam" says of decisions: cache, compiler, and who takes the steps of a sweep.
#
# It is quiet unless a program asks for it.

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
    library = native_library.Library((), (), "this is no C")
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
    monkeypatch.setattr(jax.config, "update", lambda name, value: None)
    monkeypatch.setenv(cache_folder.SIZE_VARIABLE, "8")
    with caplog.at_level(logging.INFO, "jaxbeam"):
        cache_folder.switch_on()
    assert caplog.messages[0].startswith("compile cache in ")


def test_nothing_is_logged_by_default():
    program = (
        "import jaxbeam as jb, logging; logging.getLogger('jaxbeam.simulation').info('a decision')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


BEAM = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
KEPT = jb.Case(BEAM, sensors=[jb.Sensor(0.3)])


def counted():
    """A remembered function, and the trees of which it was computed."""
    computed = []

    @remembered
    def function(tree):
        computed.append(tree)
        return len(computed)

    return function, computed


def test_equal_contents_are_computed_once():
    function, computed = counted()
    again = jb.replace(KEPT, {"beam.length": 0.6})
    assert again is not KEPT and function(KEPT) == function(again) == 1 and len(computed) == 1


def test_other_contents_are_computed():
    """Other numbers, another structure, another shape with the same bytes, another class."""
    function, _ = counted()
    others = (
        KEPT,
        jb.replace(KEPT, {"beam.length": np.nextafter(0.6, 1.0)}),
        dataclasses.replace(KEPT, sensors=(*KEPT.sensors, jb.Sensor(0.2))),
        dataclasses.replace(KEPT, sensors=(jb.Sensor(0.3, quantity="velocity"),)),
    )
    assert [function(other) for other in others] == [1, 2, 3, 4]
    one, two = np.zeros((1, 2)), np.zeros((2, 1))
    assert (function(one), function(two), function([two])) == (5, 6, 7)


def test_few_results_are_kept():
    function, computed = counted()
    for number in (*range(KEPT_RESULTS + 1), 0):
        function(float(number))
    assert len(computed) == KEPT_RESULTS + 2
