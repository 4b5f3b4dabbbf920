"""Key of a compiled program: a hash of all that decides it, known before anything is traced.

It covers the function, its static arguments, the shapes and dtypes of the others, settings of JAX
and XLA, our source, versions of the packages that compile or are compiled, and the machine. A
function that depends on other code, whose changes no version tells, has no key.
"""

import functools
import hashlib
import importlib.metadata
import os
import pathlib
import sys

import jax

from jaxbeam.runtime.cache_folder import machine_description
from jaxbeam.runtime.trusted_code import PICKLING_ERRORS, pickled

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
