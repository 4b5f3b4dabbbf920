"""The compile cache: a stored program is used if code, options and machine have not changed."""

import dataclasses
import hashlib
import importlib.metadata
import os
import pickle
import re
import subprocess
import sys
import threading

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.runtime import compile_cache, compiling
from jaxbeam.runtime.compiling import compiled
from tests.modules import ROOT

POINTS = np.array([[2.0, 0.5], [0.5, 3.0]])
TRACED = []


class Pair(eqx.Module):
    """A module with arrays, static fields, and a field that is None."""

    first: jax.Array
    words: str = eqx.field(static=True)
    size: object = eqx.field(static=True, default=abs)
    second: jax.Array | None = None


@compiled
def pairs(x, words: str, power: float = 1.0):
    """Outputs of all kinds; the factorisation needs LAPACK, which must be loaded for it."""
    TRACED.append(x.shape)
    return Pair(jnp.linalg.cholesky(x) ** power, words), {"sum": jnp.sum(x)}


@compiled(xla_backend_optimization_level=1)
def unoptimised(x):
    TRACED.append(x.shape)
    return 2 * x


@compiled
def doubled(x, about: object):
    TRACED.append(about)
    return 2 * x


@compiled
def first_array(pair: Pair):
    TRACED.append(pair.words)
    return pair.first


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty cache folder; functions of this file can be cached."""
    monkeypatch.setattr(compile_cache, "OWN_PACKAGES", ("jaxbeam", "tuning", "tests"))
    packages = {*compile_cache.VERSIONED_PACKAGES, "tests"}
    monkeypatch.setattr(compile_cache, "VERSIONED_PACKAGES", packages)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("JAXBEAM_CACHE_SIZE", "64")
    clear_process_caches()
    yield tmp_path / "jaxbeam"
    clear_process_caches()


def clear_process_caches():
    """Clear all caches of this process, as in a new one."""
    compiling.clear_caches()
    compile_cache.environment_hash.cache_clear()
    TRACED.clear()


def call(function, *args, **kwargs):
    """Result of a function that is precompiled, and the number of times that it was traced."""
    function.precompile(*args, **kwargs)()
    result = function(*args, **kwargs)
    return result, len(TRACED)


def programs(folder):
    return sorted(folder.glob("program-*"))


def test_a_cached_program_is_not_traced_again(folder):
    (first, total), count = call(pairs, POINTS, "as given")
    assert count == 1 and len(programs(folder)) == 1
    clear_process_caches()
    template, _ = pairs.template(POINTS, "as given")
    (second, other), count = call(pairs, POINTS, "as given")
    assert count == 0 and len(programs(folder)) == 1
    assert jax.tree.structure(first) == jax.tree.structure(second) == jax.tree.structure(template)
    assert second.size is abs and second.second is None
    assert_allclose(first.first, np.linalg.cholesky(POINTS), rtol=1e-14)
    assert np.array_equal(first.first, second.first) and total == other


def test_calls_find_a_cached_program_without_precompilation(folder):
    for count in (1, 0):
        for _ in range(2):
            assert_allclose(unoptimised(POINTS), 2 * POINTS, rtol=0)
        assert len(TRACED) == count and len(programs(folder)) == 1
        clear_process_caches()


def test_nested_functions_are_not_cached(folder):
    """Variables of the function around them are no part of the key."""

    def times(factor):
        @compiled
        def scaled(x):
            return factor * x

        return scaled

    for factor in (2.0, 3.0):
        assert_allclose(times(factor)(POINTS), factor * POINTS, rtol=0)
        clear_process_caches()
    assert not programs(folder)


def test_derivatives_of_a_cached_function(folder):
    for _ in range(2):
        call(unoptimised, POINTS)
        slope = jax.grad(lambda x: jnp.sum(unoptimised(x) ** 2))(POINTS)
        assert_allclose(slope, 8 * POINTS, rtol=1e-14)
        clear_process_caches()


@pytest.mark.parametrize(
    "other",
    [
        lambda: call(pairs, POINTS, "others"),
        lambda: call(pairs, POINTS, "as given", 2.0),
        lambda: call(pairs, POINTS[:1, :1], "as given"),
        lambda: call(pairs, POINTS.astype(np.float32), "as given"),
        lambda: call(unoptimised, POINTS),
    ],
    ids=["static string", "static number", "shape", "dtype", "function"],
)
def test_another_signature_or_function_is_another_program(folder, other):
    call(pairs, POINTS, "as given")
    clear_process_caches()
    assert other()[1] == 1 and len(programs(folder)) == 2


def changed_setting(patch):
    patch.setattr(unoptimised, "settings", {"xla_backend_optimization_level": 0})


def changed_source(patch):
    before = compile_cache.environment_hash()
    patch.setattr(compile_cache, "environment_hash", lambda: before + b"changed")


def changed_machine(patch):
    patch.setattr(compile_cache, "machine_description", lambda: "another")


def changed_flags(patch):
    patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")


@pytest.mark.parametrize(
    "change", [changed_setting, changed_source, changed_machine, changed_flags]
)
def test_the_key_depends_on_options_source_machine_and_settings(folder, change, monkeypatch):
    call(unoptimised, POINTS)
    clear_process_caches()
    with monkeypatch.context() as patch:
        change(patch)
        assert call(unoptimised, POINTS)[1] == 1 and len(programs(folder)) == 2
    clear_process_caches()
    assert call(unoptimised, POINTS)[1] == 0
    clear_process_caches()
    with jax.default_matmul_precision("highest"):
        assert call(unoptimised, POINTS)[1] == 1 and len(programs(folder)) == 3


def test_a_changed_source_file_changes_the_environment_hash(tmp_path, monkeypatch):
    hashes = [compile_cache.environment_hash()]
    package = tmp_path / "jaxbeam"
    package.mkdir(exist_ok=True)
    monkeypatch.setattr(compile_cache, "__file__", str(package / "runtime" / "program_key.py"))
    for text in ("a = 1\n", "a = 2\n"):
        (package / "modes.py").write_text(text)
        compile_cache.environment_hash.cache_clear()
        hashes.append(compile_cache.environment_hash())
    assert len(set(hashes)) == 3


@dataclasses.dataclass(frozen=True)
class Outsider:
    """Stands for a class of a package whose version is not part of the key."""

    number: int = 1


CONSTANT = Outsider(2)


def test_versions_of_packages_that_compile_change_the_environment_hash(monkeypatch):
    declared = {
        re.split(r"[^\w.-]", one)[0] for one in importlib.metadata.requires("jaxbeam") or []
    }
    for name in declared & {one.name.lower() for one in importlib.metadata.distributions()}:
        needs = importlib.metadata.requires(name) or []
        if any(re.match(r"jax(lib)?\b(?!.*extra ==)", one) for one in needs):
            assert name in compile_cache.DEPENDENCIES
    before, version = compile_cache.environment_hash(), importlib.metadata.version
    for changed in ("diffrax", "jaxlib"):
        compile_cache.environment_hash.cache_clear()

        def newer(name, changed=changed):
            return "99" if name == changed else version(name)

        with monkeypatch.context() as patch:
            patch.setattr(importlib.metadata, "version", newer)
            assert compile_cache.environment_hash() != before


def test_functions_that_depend_on_external_code_are_not_cached(folder, monkeypatch):
    packages = {"jaxbeam", "jax", "jaxlib", "numpy"}
    monkeypatch.setattr(compile_cache, "VERSIONED_PACKAGES", packages)
    for constant in (Outsider(), CONSTANT, changed_flags):
        for _ in range(2):
            assert call(doubled, POINTS, constant)[1] == 1
            clear_process_caches()
    for _ in range(2):
        assert call(first_array, Pair(POINTS, "a class of others"))[1] == 1
        clear_process_caches()
    monkeypatch.setattr(compile_cache, "OWN_PACKAGES", ("jaxbeam", "tuning"))
    assert call(unoptimised, POINTS)[1] == 1
    assert not programs(folder)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(path.read_bytes()[:-100]),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:50] + b"x" + path.read_bytes()[51:]),
        lambda path: path.chmod(0o666),
    ],
    ids=["cut off", "empty", "changed", "writable by others"],
)
def test_a_refused_program_is_compiled_and_stored_again(folder, spoil):
    call(unoptimised, POINTS)
    (path,) = programs(folder)
    spoil(path)
    clear_process_caches()
    with pytest.warns(UserWarning, match="compile cache not used: .*program-unoptimised"):
        result, count = call(unoptimised, POINTS)
    assert_allclose(result, 2 * POINTS, rtol=0)
    assert count == 1
    clear_process_caches()
    assert call(unoptimised, POINTS)[1] == 0


def test_a_forged_program_is_never_unpickled(folder):
    """A plain digest, which anybody can compute, does not vouch for it."""
    call(unoptimised, POINTS)
    (path,) = programs(folder)
    content = pickle.dumps((b"code", MaliciousPickle()))
    path.write_bytes(hashlib.sha256(content).digest() + content)
    clear_process_caches()
    with pytest.warns(UserWarning, match="was not written with the key of this user"):
        assert call(unoptimised, POINTS)[1] == 1
    assert not EXECUTED
    pickle.loads(content)
    assert EXECUTED


EXECUTED = []


def record_execution():
    EXECUTED.append(True)


class MaliciousPickle:
    """An object that runs code when it is unpickled."""

    def __reduce__(self):
        return record_execution, ()


def test_a_program_that_cannot_be_loaded_is_compiled_again(folder, monkeypatch):
    call(unoptimised, POINTS)
    clear_process_caches()

    def fail(*_):
        raise jax.errors.JaxRuntimeError("made for another machine after all")

    monkeypatch.setattr(compile_cache, "load_program", fail)
    result, count = call(unoptimised, POINTS)
    assert_allclose(result, 2 * POINTS, rtol=0)
    assert count == 1


def test_an_unusable_folder_gives_one_warning(folder, monkeypatch):
    folder.write_text("")
    with pytest.warns(
        UserWarning, match="compile cache not used: .*jaxbeam cannot be used"
    ) as caught:
        assert call(unoptimised, POINTS)[1] == 1
    assert len(caught) == 1
    clear_process_caches()
    folder.unlink()
    folder.mkdir(mode=0o777)
    folder.chmod(0o777)
    with pytest.warns(UserWarning, match="other users may write to .*jaxbeam; delete it") as caught:
        assert call(unoptimised, POINTS)[1] == 1
    assert len(caught) == 1 and not programs(folder)


def test_the_least_recently_used_programs_are_evicted(folder, monkeypatch):
    monkeypatch.setattr(compile_cache, "max_bytes", lambda: 10**8)
    for power in (1, 2):
        call(pairs, POINTS, "as given", power)
    old, new = sorted(programs(folder), key=os.path.getmtime)
    os.utime(old, (1, 1))
    size = new.stat().st_size
    monkeypatch.setattr(compile_cache, "max_bytes", lambda: 5 * size // 2)
    call(pairs, POINTS, "as given", 3)
    assert len(programs(folder)) == 2 and new.exists() and not old.exists()


@pytest.mark.parametrize("size", ["0", "-1"])
def test_size_zero_switches_the_cache_off(folder, monkeypatch, size):
    monkeypatch.setenv("JAXBEAM_CACHE_SIZE", size)
    assert call(unoptimised, POINTS)[1] == 1
    assert unoptimised(POINTS)[0, 0] == 4 and not folder.exists()


def test_a_size_that_is_no_number_gives_a_warning(folder, monkeypatch):
    monkeypatch.setenv("JAXBEAM_CACHE_SIZE", "1 GB")
    with pytest.warns(UserWarning, match="JAXBEAM_CACHE_SIZE is to be a whole number of MiB, not"):
        assert call(unoptimised, POINTS)[1] == 1
    assert not folder.exists()


def test_scripts_cache_programs_where_jax_does_unless_set_otherwise(monkeypatch, jax_cache):
    monkeypatch.delenv("JAXBEAM_CACHE_SIZE")
    assert compile_cache.max_bytes() == 512 * 2**20
    jax.config.update("jax_enable_compilation_cache", False)
    assert compile_cache.max_bytes() == 0
    jax.config.update("jax_enable_compilation_cache", True)
    jax.config.update("jax_compilation_cache_dir", None)
    assert compile_cache.max_bytes() == 0
    monkeypatch.setenv("JAXBEAM_CACHE_SIZE", "3")
    assert compile_cache.max_bytes() == 3 * 2**20


@pytest.fixture
def jax_cache(tmp_path):
    """A folder for JAX's own cache."""
    from jax.experimental.compilation_cache import compilation_cache

    before = jax.config.jax_compilation_cache_dir
    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "jax"))
    yield tmp_path / "jax"
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()


def test_jax_does_not_store_a_cached_program_again(folder, jax_cache):
    for count in (1, 0):
        assert call(unoptimised, POINTS)[1] == count
        clear_process_caches()
    jax.jit(jnp.sin)(0.5)
    names = [path.name for path in jax_cache.iterdir()]
    assert len(programs(folder)) == 1
    assert any("sin" in name for name in names) and not any("unoptimised" in name for name in names)


def test_jax_stores_programs_without_a_key(folder, jax_cache, monkeypatch):
    monkeypatch.setattr(compile_cache, "OWN_PACKAGES", ("jaxbeam", "tuning"))
    call(unoptimised, POINTS)
    assert not programs(folder)
    assert any("unoptimised" in path.name for path in jax_cache.iterdir())


def test_threads_that_compile_restore_the_settings_of_jax():
    name = compile_cache.MIN_COMPILE_TIME
    before = getattr(jax.config, name)
    inside, leave = threading.Event(), threading.Event()

    def compile_slowly():
        with compile_cache.jax_cache_off():
            inside.set()
            leave.wait()

    thread = threading.Thread(target=compile_slowly)
    thread.start()
    inside.wait()
    with compile_cache.jax_cache_off():
        leave.set()
        thread.join()
        assert getattr(jax.config, name) == float("inf")
    assert getattr(jax.config, name) == before


def test_commands_switch_the_cache_on_in_their_own_folder(folder, monkeypatch, jax_cache):
    for name in ("JAXBEAM_CACHE_SIZE", "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    compile_cache.switch_on()
    assert os.environ["JAXBEAM_CACHE_SIZE"] == "512" and compile_cache.enabled()
    assert jax.config.jax_compilation_cache_dir == str(folder / "jax")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "elsewhere")
    jax.config.update("jax_compilation_cache_dir", "elsewhere")
    compile_cache.switch_on()
    assert jax.config.jax_compilation_cache_dir == "elsewhere"
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    (folder / "jax").chmod(0o777)
    with pytest.warns(UserWarning, match="other users may write to .*jax; delete it"):
        compile_cache.switch_on()


SWEEP_SCRIPT = """
import sys
import numpy as np
import jaxbeam as jb
from jaxbeam.integrator import native_peaks
from jaxbeam.runtime import compiling, native_library
from tests.runtime.test_compile_cache import CASES, OVER

compiled = []
compile = compiling.Compiled._compile

def counted(self, entry, lowered):
    compiled.append(self.__name__)
    compile(self, entry, lowered)

compiling.Compiled._compile = counted
if native_library.find_compiler():
    native_peaks.LIBRARY.build()
results = [jb.sweep(case, OVER, progress=False, **how) for case, how in CASES]
names = ("peak_deflection", "lowest_contact_force", "deflection")
values = [run[name].values.ravel() for run in results for name in names if name in run]
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


def test_sweeps_of_the_next_process_compile_nothing_and_are_the_same(tmp_path):
    changed = {"JAXBEAM_CACHE_SIZE": "512", "XDG_CACHE_HOME": str(tmp_path)}
    compiled_names = []
    for name in ("first.npy", "second.npy"):
        command = [sys.executable, "-c", SWEEP_SCRIPT, str(tmp_path / name)]
        process = subprocess.run(
            command, env=os.environ | changed, cwd=ROOT, check=True, capture_output=True, text=True
        )
        compiled_names.append(process.stdout.split())
        assert not process.stderr
    expected = {"integrate_block", "discrete_models"}
    assert expected <= set(compiled_names[0]) and not compiled_names[1]
    first, second = (np.load(tmp_path / name) for name in ("first.npy", "second.npy"))
    assert np.array_equal(first, second) and np.all(np.isfinite(first))
