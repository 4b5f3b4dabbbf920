"""The one file in which bytes become code that runs: C libraries.

They run with the rights of the user. What is loaded here comes from the cache folder, after
`cache_folder.read_file` has verified its owner, its mode and its HMAC, or is a library that was
installed with the package, as its Python code was. No module of the repository unpickles, evaluates
or executes what it reads, and no other loads a library: a test of the store goes through the source
of all.
"""

import ctypes
import pathlib

from jaxbeam.runtime.cache_folder import private_folder, read_file, temporary_file

NativeCode = ctypes.CDLL  # whose attributes are its functions


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
