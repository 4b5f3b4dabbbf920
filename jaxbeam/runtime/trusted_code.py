"""The one file in which bytes become code that runs: pickles, compiled programs, C libraries.

Each of these runs with the rights of the user. What is read here comes from the cache folder,
after `cache_folder.read_file` has verified its owner, its mode and its HMAC, or is a library that
was installed with the package, as its Python code was. No other module of the
repository unpickles, evaluates or executes what it reads, or loads a library: a test of the store
goes through the source of all.
"""

import ctypes
import io
import pathlib
import pickle
import sys
import types
from collections.abc import Collection
from typing import Any

import jax
from jax.experimental import serialize_executable

from jaxbeam.runtime.cache_folder import private_folder, read_file, temporary_file

NativeCode = ctypes.CDLL  # whose attributes are its functions


class ExternalCode(Exception):
    """A pickle depends on code of a package whose version is not known."""


PICKLING_ERRORS = (ExternalCode, pickle.PicklingError, AttributeError, TypeError)


class _Pickler(pickle.Pickler):
    """Pickler whose bytes are equal in every process, for objects of some packages only."""

    def __init__(self, file: io.BytesIO, packages: Collection[str]):
        super().__init__(file, protocol=5)
        self.packages = packages

    def reducer_override(self, obj):
        """Classes and functions by name, sentinels by the name of their module's constant.

        Raises ExternalCode for what another package defines.
        """
        named = isinstance(obj, type | types.FunctionType | types.BuiltinFunctionType)
        if str((obj if named else type(obj)).__module__).split(".")[0] not in self.packages:
            raise ExternalCode(obj)
        if named:
            return NotImplemented
        # Sentinels, such as equinox has for a missing value, are compared by identity.
        if type(obj).__reduce__ is object.__reduce__:
            constants = vars(sys.modules[type(obj).__module__]).items()
            return next((name for name, value in constants if value is obj), NotImplemented)
        return NotImplemented


def pickled(obj: Any, packages: Collection[str]) -> bytes:
    """Pickle of an object of some packages. Raises one of PICKLING_ERRORS if it has none."""
    file = io.BytesIO()
    pickler = _Pickler(file, packages)
    pickler.fast = True  # without a memo, equal objects give equal bytes, identical or not
    pickler.dump(obj)
    return file.getvalue()


def unpickled(name: str) -> Any:
    """Object in a file of the cache folder; None if there is no such file.

    Raises CacheError if others may have written it or it is damaged.
    """
    content = read_file(name)
    return None if content is None else pickle.loads(content)


def loaded_program(code: bytes, arguments: Any, outputs: Any) -> jax.stages.Compiled:
    """Program from its code, which was `unpickled`; JAX unpickles parts of it.

    For arguments and outputs with the tree structure of these.
    """
    trees = jax.tree.structure((arguments, {})), jax.tree.structure(outputs)
    return serialize_executable.deserialize_and_load(code, *trees)


def loaded_library(name: str) -> NativeCode:
    """C library in a file of the cache folder.

    The bytes that were verified are loaded, from a file of this process. Raises CacheError if
    others may have written it or it is damaged, OSError if it is missing or no library.
    """
    with temporary_file(private_folder(), read_file(name) or b"") as path:
        return ctypes.CDLL(path)


def library_of_wheel(path: pathlib.Path) -> NativeCode:
    """C library in the installed package. Raises OSError if it cannot be loaded here."""
    return ctypes.CDLL(str(path))
