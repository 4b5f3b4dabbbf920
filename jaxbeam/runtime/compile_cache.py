"""Cache of compiled programs on disk, found again without tracing.

JAX's own cache finds a program after tracing and lowering, which take longer than loading it. Here
its name is a hash known before (`program_key`), in a folder private to the user (`cache_folder`).
Programs are for one CPU device. Loading unpickles, here and within JAX: `trusted_code` does so once
the file's HMAC is verified.

`docs/howto/speed.md` says how scripts switch it on and commands off.

The key of a program is a hash of all that decides it, known before anything is traced.
It covers the function, its static arguments, the shapes and dtypes of the others, settings of JAX
and XLA, our source, versions of the packages that compile or are compiled, and the machine. A
function that depends on other code, whose changes no version tells, has no key.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import logging
import os
import pathlib
import sys
import threading
import warnings
from typing import Any

import jax
from jax.experimental import serialize_executable

from jaxbeam.runtime import cache_folder
from jaxbeam.runtime.cache_folder import CacheError, machine_description
from jaxbeam.runtime.trusted_code import PICKLING_ERRORS, loaded_program, pickled, unpickled

LOGGER = logging.getLogger(__name__)
OWN_PACKAGES = ("jaxbeam", "tuning")  # whose source is hashed
# Packages whose functions may be compiled; a test compares them with the declared dependencies.
DEPENDENCIES = (
    *("jax", "jaxlib", "numpy", "scipy", "jaxtyping", "equinox", "optax"),
    *("diffrax", "optimistix", "lineax", "qpax", "blackjax"),
)
VERSIONED_PACKAGES = {
    *OWN_PACKAGES,
    *("jax", "jaxlib", "equinox", "numpy", "scipy"),
    *sys.stdlib_module_names,
}
# Settings of JAX that change no program, or are part of the argument signature.
IGNORED_SETTINGS = ("jax_compilation_cache", "jax_persistent_cache", "jax_log", "jax_enable_x64")


def program_name(function, identity: tuple) -> str | None:
    """File name of a program, from the hash of its key; None if it has no key.

    `identity` is the argument signature of the function, a `compiling.Compiled`.
    """
    if not _is_cacheable(function):
        return None
    key = function.__module__, function.__name__, function.settings, identity, _jax_settings()
    try:
        serialised_key = serialise(key)
    except PICKLING_ERRORS:
        return None
    digest = hashlib.sha256(environment_hash() + serialised_key).hexdigest()[:32]
    return f"program-{function.__name__}-{digest}"


def _is_cacheable(function) -> bool:
    """Whether a function is ours and global: a nested one may depend on variables around it."""
    if function.__module__.split(".")[0] not in OWN_PACKAGES:
        return False
    found = getattr(sys.modules[function.__module__], function.__qualname__, None)
    return found is function or found is function.__wrapped__


def serialise(obj) -> bytes:
    """Pickle of an object of versioned packages. Raises one of PICKLING_ERRORS if it has none."""
    return pickled(obj, VERSIONED_PACKAGES)


def _jax_settings() -> list[tuple[str, str]]:
    """Settings of JAX that may change a program."""
    names = (name for name in sorted(jax.config.values) if not name.startswith(IGNORED_SETTINGS))
    return [(name, repr(getattr(jax.config, name, None))) for name in names]


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:  # an optional dependency
        return ""


@functools.cache
def environment_hash() -> bytes:
    """SHA-256 of our source, versions of dependencies, machine and XLA flags."""
    descriptions = [
        machine_description(),
        jax.default_backend(),
        os.environ.get("XLA_FLAGS", ""),
        sys.version,
    ]
    descriptions += map(_version, DEPENDENCIES)
    digest = hashlib.sha256("\n".join(descriptions).encode())
    root = pathlib.Path(__file__).parents[2]
    for path in sorted(path for package in OWN_PACKAGES for path in (root / package).rglob("*")):
        if path.suffix in (".py", ".c", ".h"):
            digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.digest()


SIZE_VARIABLE = "JAXBEAM_CACHE_SIZE"  # MiB; 0 switches the cache off
DEFAULT_SIZE = 512  # MiB, some 500 programs
MIN_COMPILE_TIME = "jax_persistent_cache_min_compile_time_secs"


def switch_on() -> None:
    """Cache the programs of this process and of those it starts, as all commands do.

    JAX's cache then holds, in the same folder, what is compiled without a key; but settings of
    the user prevail, JAXBEAM_CACHE_SIZE=0 and JAX_COMPILATION_CACHE_DIR too.
    """
    os.environ.setdefault(SIZE_VARIABLE, str(DEFAULT_SIZE))
    if not max_bytes() or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    try:
        folder = cache_folder.private_folder(cache_folder.JAX_FOLDER)
    except CacheError as error:
        _warn(error)
        return
    LOGGER.info("compile cache in %s", folder.parent)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if MIN_COMPILE_TIME.upper() not in os.environ:
        jax.config.update(MIN_COMPILE_TIME, 0.3)


def max_bytes() -> int:
    """Size limit of the cache; 0 if it is off.

    JAXBEAM_CACHE_SIZE in MiB; if it is not set, DEFAULT_SIZE where JAX's cache is on, else 0.
    """
    text = os.environ.get(SIZE_VARIABLE)
    if not jax.config.jax_enable_compilation_cache:
        return 0
    if text is None:
        return DEFAULT_SIZE << 20 if jax.config.jax_compilation_cache_dir else 0
    try:
        return max(int(text), 0) << 20
    except ValueError:
        _warn(f"{SIZE_VARIABLE} is to be a whole number of MiB, not {text!r}")
        return 0


def enabled() -> bool:
    """Whether programs are cached: the cache is on, and this process computes on one CPU device."""
    return max_bytes() > 0 and jax.default_backend() == "cpu" and len(jax.local_devices()) == 1


def save_program(name: str, program: jax.stages.Compiled, outputs: Any) -> None:
    """Store a program with the shapes and static parts of its outputs, if both can be pickled.

    A folder that cannot be used makes a warning.
    """
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), outputs)
    try:
        content = serialise((serialize_executable.serialize(program)[0], shapes))
    except (*PICKLING_ERRORS, ValueError, NotImplementedError):
        return
    try:
        cache_folder.write_file(name, content)
        cache_folder.evict(max_bytes())
    except CacheError as error:
        _warn(error)


def read_program(name: str) -> tuple[bytes, Any] | None:
    """Code of a stored program, and its outputs as given to `save_program`; None if not stored.

    A file that is refused makes a warning; it is replaced when the program has been compiled.
    """
    try:
        stored = unpickled(name)
    except CacheError as error:
        _warn(error)
        return None
    LOGGER.debug("program %s: %s", name, "cached" if stored else "to be compiled")
    if stored is not None:
        cache_folder.mark_used(name)
    return stored


def load_program(code: bytes, arguments: Any, outputs: Any) -> jax.stages.Compiled:
    """Program from its code, for arguments and outputs with the tree structure of these."""
    if b"lapack" in code:  # only then, as it takes as long as loading all the rest
        _load_lapack()
    return loaded_program(code, arguments, outputs)


@functools.cache
def _load_lapack() -> None:
    """Load LAPACK, which JAX does when it lowers a program with a factorisation."""
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))


class _JaxCacheOff:
    """Context in which JAX's own cache stores nothing: what is stored here is not stored twice.

    JAX has no such setting for one thread, so programs that other threads compile meanwhile are
    not stored either.
    """

    def __init__(self):
        self.lock = threading.Lock()
        self.depth = 0
        self.min_compile_time = 0.0

    @contextlib.contextmanager
    def __call__(self):
        with self.lock:
            if self.depth == 0:
                self.min_compile_time = getattr(jax.config, MIN_COMPILE_TIME)
                jax.config.update(MIN_COMPILE_TIME, float("inf"))
            self.depth += 1
        try:
            yield
        finally:
            with self.lock:
                self.depth -= 1
                if self.depth == 0:
                    jax.config.update(MIN_COMPILE_TIME, self.min_compile_time)


jax_cache_off = _JaxCacheOff()


def _warn(reason: CacheError | str) -> None:
    warnings.warn(f"compile cache not used: {reason}", stacklevel=2)
