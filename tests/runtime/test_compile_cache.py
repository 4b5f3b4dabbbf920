"""Programs kept for later processes: found where nothing has changed, and only there."""

import dataclasses
import importlib.metadata
import os
import re
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.runtime import compile_cache, compiling
from jaxbeam.runtime.compiling import compiled, compiled_with
from tests.modules import ROOT

POINTS = np.array([[2.0, 0.5], [0.5, 3.0]])
TRACED = []


class Pair(eqx.Module):
    """Something with numbers, constants, and nothing where something could be."""

    first: jax.Array
    words: str = eqx.field(static=True)
    size: object = eqx.field(static=True, default=abs)
    second: jax.Array | None = None


@compiled
def pairs(x, words: str, power: float = 1.0):
    """A function with a factorisation, to see that LAPACK is there for it."""
    TRACED.append(x.shape)
    return Pair(jnp.linalg.cholesky(x) ** power, words), {"sum": jnp.sum(x)}


@compiled_with(xla_backend_optimization_level=1)
def roughly(x):
    TRACED.append(x.shape)
    return 2 * x


@compiled
def doubled(x, about: object):
    TRACED.append(about)
    return 2 * x


@compiled
def first_of(pair: Pair):
    TRACED.append(pair.words)
    return pair.first


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A cache folder of its own; functions of this file are trusted not to change."""
    monkeypatch.setattr(compile_cache, "OURS", ("jaxbeam", "tuning", "tests"))
    monkeypatch.setattr(compile_cache, "SAFE", {*compile_cache.VERSIONED_PACKAGES, "tests"})
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    again()
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)
    again()


def again():
    """Forget all, as the next process would not know it."""
    compiling.clear_caches()
    compile_cache._environment_hash.cache_clear()
    TRACED.clear()


def called(function, *args, **kwargs):
    """What a function returns when it is compiled ahead, and how often that has traced it."""
    function.ahead(*args, **kwargs)()
    found = function(*args, **kwargs)
    return found, len(TRACED)


def kept(folder):
    return sorted(folder.glob("jaxbeam-*"))


def test_what_an_earlier_process_has_compiled_is_not_traced_again(folder):
    (first, total), count = called(pairs, POINTS, "as given")
    assert count == 1 and len(kept(folder)) == 1
    again()
    blank, _ = pairs.template(POINTS, "as given")
    (second, other), count = called(pairs, POINTS, "as given")
    assert count == 0 and len(kept(folder)) == 1
    assert jax.tree.structure(first) == jax.tree.structure(second) == jax.tree.structure(blank)
    assert second.size is abs and second.second is None
    assert_allclose(first.first, np.linalg.cholesky(POINTS), rtol=1e-14)
    assert np.array_equal(first.first, second.first) and total == other


def test_calls_find_it_as_well(folder):
    for count in (1, 0):
        for _ in range(2):
            assert_allclose(roughly(POINTS), 2 * POINTS, rtol=0)
        assert len(TRACED) == count and len(kept(folder)) == 1
        again()


def test_functions_within_others_are_not_kept(folder):
    """What they use of their surroundings is no part of the key."""

    def times(factor):
        @compiled
        def scaled(x):
            return factor * x

        return scaled

    for factor in (2.0, 3.0):
        assert_allclose(times(factor)(POINTS), factor * POINTS, rtol=0)
        again()
    assert not kept(folder)


def test_derivatives_are_those_of_the_function(folder):
    for _ in range(2):
        called(roughly, POINTS)
        slope = jax.grad(lambda x: jnp.sum(roughly(x) ** 2))(POINTS)
        assert_allclose(slope, 8 * POINTS, rtol=1e-14)
        again()


@pytest.mark.parametrize(
    "other",
    [
        lambda: called(pairs, POINTS, "others"),
        lambda: called(pairs, POINTS, "as given", 2.0),
        lambda: called(pairs, POINTS[:1, :1], "as given"),
        lambda: called(pairs, POINTS.astype(np.float32), "as given"),
        lambda: called(roughly, POINTS),
    ],
    ids=["words", "number", "shape", "precision", "function"],
)
def test_another_program_has_another_place(folder, other):
    called(pairs, POINTS, "as given")
    again()
    assert other()[1] == 1 and len(kept(folder)) == 2


def changed_setting(patch):
    patch.setattr(roughly, "settings", {"xla_backend_optimization_level": 0})


def changed_source(patch):
    before = compile_cache._environment_hash()
    patch.setattr(compile_cache, "_surroundings", lambda: before + b"changed")


def changed_machine(patch):
    patch.setattr(compile_cache, "machine", lambda: "another")


def changed_flags(patch):
    patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")


@pytest.mark.parametrize(
    "change", [changed_setting, changed_source, changed_machine, changed_flags]
)
def test_what_else_decides_a_program_is_part_of_its_place(folder, change, monkeypatch):
    called(roughly, POINTS)
    again()
    with monkeypatch.context() as patch:
        change(patch)
        assert called(roughly, POINTS)[1] == 1 and len(kept(folder)) == 2
    again()
    assert called(roughly, POINTS)[1] == 0
    again()
    with jax.default_matmul_precision("highest"):
        assert called(roughly, POINTS)[1] == 1 and len(kept(folder)) == 3


def test_a_changed_source_is_noticed(folder, tmp_path, monkeypatch):
    before = compile_cache._environment_hash()
    home = tmp_path / "jaxbeam"
    home.mkdir()
    monkeypatch.setattr(compile_cache, "__file__", str(home / "runtime" / "compile_cache.py"))
    marks = [before]
    for text in ("a = 1\n", "a = 2\n"):
        (home / "modes.py").write_text(text)
        compile_cache._environment_hash.cache_clear()
        marks.append(compile_cache._environment_hash())
    assert len(set(marks)) == 3


@dataclasses.dataclass(frozen=True)
class Outsider:
    """A constant of a class whose code is not known to stay the same."""

    number: int = 1


CONSTANT = Outsider(2)


def test_versions_of_all_that_compiles_are_part_of_the_place(monkeypatch):
    declared = {
        re.split(r"[^\w.-]", one)[0] for one in importlib.metadata.requires("jaxbeam") or []
    }
    for name in declared & {one.name.lower() for one in importlib.metadata.distributions()}:
        needs = importlib.metadata.requires(name) or []
        if any(re.match(r"jax(lib)?\b(?!.*extra ==)", one) for one in needs):
            assert name in compile_cache.DEPENDENCIES
    before, version = compile_cache._environment_hash(), importlib.metadata.version
    for changed in ("diffrax", "jaxlib"):
        compile_cache._environment_hash.cache_clear()

        def newer(name, changed=changed):
            return "99" if name == changed else version(name)

        with monkeypatch.context() as patch:
            patch.setattr(importlib.metadata, "version", newer)
            assert compile_cache._environment_hash() != before


def test_what_depends_on_code_of_others_is_not_kept(folder, monkeypatch):
    monkeypatch.setattr(compile_cache, "SAFE", {"jaxbeam", "jax", "jaxlib", "numpy"})
    for constant in (Outsider(), CONSTANT, changed_flags):
        for _ in range(2):
            assert called(doubled, POINTS, constant)[1] == 1
            again()
    for _ in range(2):
        assert called(first_of, Pair(POINTS, "a class of others"))[1] == 1
        again()
    monkeypatch.setattr(compile_cache, "OURS", ("jaxbeam", "tuning"))
    assert called(roughly, POINTS)[1] == 1
    assert not kept(folder)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(path.read_bytes()[:-100]),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:50] + b"x" + path.read_bytes()[51:]),
    ],
    ids=["cut off", "empty", "changed"],
)
def test_what_is_damaged_is_compiled_again_and_mended(folder, spoil):
    called(roughly, POINTS)
    (path,) = kept(folder)
    spoil(path)
    for count in (1, 0):
        again()
        found, traced = called(roughly, POINTS)
        assert_allclose(found, 2 * POINTS, rtol=0)
        assert traced == count


def test_what_cannot_be_loaded_is_compiled_again(folder, monkeypatch):
    called(roughly, POINTS)
    again()

    def fail(*_):
        raise jax.errors.JaxRuntimeError("made for another machine after all")

    monkeypatch.setattr(compile_cache, "load", fail)
    found, traced = called(roughly, POINTS)
    assert_allclose(found, 2 * POINTS, rtol=0)
    assert traced == 1


def test_without_a_folder_to_write_to_all_goes_on(folder):
    (folder / "file").write_text("")
    for place in (str(folder / "file"), "", None, "gs://somewhere/else"):
        if place != "gs://somewhere/else":  # which JAX itself would not accept here
            jax.config.update("jax_compilation_cache_dir", place)
            assert called(roughly, POINTS)[1] == 1
        again()
    assert not kept(folder)


SWEPT = """
import sys
import numpy as np
import jaxbeam as jb
from jaxbeam import compiling, native, native_library
from tests.runtime.test_compile_cache import CASES, OVER

compiled = []
compile = compiling.Compiled._compile

def counted(self, state, lowered):
    compiled.append(self.__name__)
    compile(self, state, lowered)

compiling.Compiled._compile = counted
if native_library.compiler():
    native.build()
found = [jb.sweep(case, OVER, progress=False, **how) for case, how in CASES]
names = ("peak_deflection", "lowest_contact_force", "deflection")
values = [run[name].values.ravel() for run in found for name in names if name in run]
np.save(sys.argv[1], np.concatenate(values).astype(float))
print(*compiled)
"""
OVER = {"loads.0.mass": [0.1, 0.3], "loads.0.speed": [1.0, 2.0]}
PLAIN = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, modes=2),
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.2, speed=1.0)],
    run=jb.Run(0.7),
)
CONTROLLED = dataclasses.replace(
    PLAIN,
    actuators=(jb.PointForce(0.3),),
    controller=jb.PD([100.0], rate_gains=[1.0], lag=[0.002], period=0.004),
)
CASES = [
    (PLAIN, {}),
    (PLAIN, {"histories": True}),
    (PLAIN, {"precision": "single"}),
    (CONTROLLED, {}),
]


@pytest.mark.slow
def test_sweeps_of_the_next_process_compile_nothing_and_are_the_same(tmp_path):
    changed = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    told = []
    for name in ("first.npy", "second.npy"):
        command = [sys.executable, "-c", SWEPT, str(tmp_path / name)]
        done = subprocess.run(
            command, env=os.environ | changed, cwd=ROOT, check=True, capture_output=True, text=True
        )
        told.append(done.stdout.split())
        assert not done.stderr
    assert {"block", "riggings", "rigs", "windows"} <= set(told[0]) and not told[1]
    first, second = (np.load(tmp_path / name) for name in ("first.npy", "second.npy"))
    assert np.array_equal(first, second) and np.all(np.isfinite(first))
