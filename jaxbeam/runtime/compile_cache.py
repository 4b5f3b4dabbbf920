"""Compiled programs kept for later processes, in the folder of JAX's persistent cache.

JAX looks there for a program only when it has been traced and lowered, which takes longer than
all that then follows. Here a program is found by what is known before: the function, the constants
among its arguments, the shapes of the others, the settings, the source, the versions, the machine.
Where one of these is code of others, which may change unnoticed, nothing is kept.

Like JAX's own, these files are machine code, and whoever can write to the folder could have any
code run: it is the user's own cache folder, never a folder of cases, logs or results.
"""

import functools
import hashlib
import importlib.metadata
import io
import os
import pathlib
import pickle
import platform
import sys
import tempfile
import types
from typing import Any

import jax
from jax.experimental import serialize_executable

OWN_PACKAGES = ("jaxbeam", "tuning")  # whose source is part of the mark
# What a program may be made of, by us or by one of these; a test compares with what is declared.
DEPENDENCIES = (
    *("jax", "jaxlib", "numpy", "scipy", "jaxtyping", "equinox", "optax"),
    *("diffrax", "optimistix", "lineax", "qpax", "blackjax"),
)
VERSIONED_PACKAGES = {
    *OWN_PACKAGES,
    "jax",
    "jaxlib",
    "equinox",
    "numpy",
    "scipy",
    *sys.stdlib_module_names,
}
# Settings of JAX that change no program, or are told with each.
IGNORED_SETTINGS = ("jax_compilation_cache", "jax_persistent_cache", "jax_log", "jax_enable_x64")


def cache_folder() -> pathlib.Path:
    """Where what is compiled is kept for later: in the user's cache folder."""
    folder = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(folder) / "jaxbeam"


def machine_description() -> str:
    """What tells this machine from others, for which what was compiled here may not run."""
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        cpu = platform.processor()
    else:
        cpu_lines = {line for line in lines if line.startswith(("model name", "flags"))}
        cpu = "".join(sorted(cpu_lines))
    return "\n".join([sys.platform, platform.machine(), cpu])


def program_folder() -> pathlib.Path | None:
    """Where programs are kept, if JAX is told where: those for CPUs, one device, one file each."""
    configured = jax.config.jax_compilation_cache_dir
    if not configured or "://" in configured or not jax.config.jax_enable_compilation_cache:
        return None
    single_cpu = jax.default_backend() == "cpu" and len(jax.local_devices()) == 1
    return pathlib.Path(configured) if single_cpu else None


def cache_path(function, identity: tuple) -> pathlib.Path | None:
    """Where a program is kept, if there is a folder and all that decides the program is known.

    `identity` is all that tells it from other programs of the function, a `compiling.Compiled`.
    """
    directory = program_folder()
    if directory is None or not _is_cacheable(function):
        return None
    key = function.__module__, function.__name__, function.settings, identity, _jax_settings()
    try:
        serialised_key = _serialise(key)
    except SERIALISATION_ERRORS:
        return None
    digest = hashlib.sha256(_environment_hash() + serialised_key).hexdigest()[:32]
    return directory / f"jaxbeam-{function.__name__}-{digest}"


def _is_cacheable(function) -> bool:
    """Whether it is ours and stands in a module: one within another may use what that was given."""
    if function.__module__.split(".")[0] not in OWN_PACKAGES:
        return False
    found = getattr(sys.modules[function.__module__], function.__qualname__, None)
    return found is function or found is function.__wrapped__


def save_program(path: pathlib.Path, program: jax.stages.Compiled, outputs: Any) -> None:
    """Keep a program, and what is known of what it returns; do nothing where that cannot be."""
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), outputs)
    try:
        content = _serialise((serialize_executable.serialize(program)[0], shapes))
        path.parent.mkdir(parents=True, exist_ok=True)
        # Made beside its place and moved there, so that nobody ever reads half of it.
        with tempfile.TemporaryDirectory(dir=path.parent) as temporary:
            temporary_file = pathlib.Path(temporary) / path.name
            temporary_file.write_bytes(hashlib.sha256(content).digest() + content)
            os.replace(temporary_file, path)
    except (*SERIALISATION_ERRORS, ValueError, NotImplementedError, OSError):
        pass  # it will be compiled again


def read_program(path: pathlib.Path) -> tuple[bytes, Any] | None:
    """The code of a program that is kept, and what it returns; None if it is missing or damaged."""
    try:
        found = path.read_bytes()
    except OSError:
        return None
    digest, content = found[:32], found[32:]
    return pickle.loads(content) if hashlib.sha256(content).digest() == digest else None


def load_program(code: bytes, arguments: Any, outputs: Any) -> jax.stages.Compiled:
    """The program, for arguments and results of the structure of these."""
    if b"lapack" in code:  # only then, as it takes as long as loading all the rest
        _load_lapack()
    trees = jax.tree.structure((arguments, {})), jax.tree.structure(outputs)
    return serialize_executable.deserialize_and_load(code, *trees)


@functools.cache
def _load_lapack() -> None:
    """Have JAX load LAPACK, as it does when it lowers a program, and no sooner."""
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))


class _ExternalCode(Exception):
    """Something depends on code whose version is not known."""


SERIALISATION_ERRORS = (_ExternalCode, pickle.PicklingError, AttributeError, TypeError)


class _Pickler(pickle.Pickler):
    """Writes things down, the same in every process, if only known code is needed for them."""

    def reducer_override(self, obj):
        """What is known by its name is written as that.

        Raises _Foreign if it is code that others may change.
        """
        named = isinstance(obj, type | types.FunctionType | types.BuiltinFunctionType)
        if str((obj if named else type(obj)).__module__).split(".")[0] not in VERSIONED_PACKAGES:
            raise _ExternalCode(obj)
        if named:
            return NotImplemented
        # Marks, such as equinox has for what is missing, stay the very same objects.
        if type(obj).__reduce__ is object.__reduce__:
            constants = vars(sys.modules[type(obj).__module__]).items()
            return next((name for name, value in constants if value is obj), NotImplemented)
        return NotImplemented


def _serialise(obj) -> bytes:
    """Something as bytes. Raises _Foreign, or an error of pickle, if it cannot be written."""
    file = io.BytesIO()
    pickler = _Pickler(file, protocol=5)
    pickler.fast = True  # equal things are written alike, whether or not they are the same
    pickler.dump(obj)
    return file.getvalue()


def _jax_settings() -> list[tuple[str, str]]:
    """The settings of JAX that may change a program."""
    names = (name for name in sorted(jax.config.values) if not name.startswith(IGNORED_SETTINGS))
    return [(name, repr(getattr(jax.config, name, None))) for name in names]


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:  # it is one of the extras
        return ""


@functools.cache
def _environment_hash() -> bytes:
    """A number for our source, the packages beneath it, and the machine."""
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
