"""Optional C code: that of a wheel, or compiled when first of use and stored in the cache folder.

A library of the cache is named by a hash of its source, its compiler flags and the machine; one of
a wheel (`hatch_build.py`) by a hash of the source and its architecture. Everything also runs
without them.

No other file makes code that runs of bytes: no module of the repository unpickles, evaluates or
executes what it reads, and no other loads a library (a test of the store goes through the source
of all). What is loaded runs with the rights of the user. It comes from the cache folder, after
`cache_folder.read_file` has verified its owner, its mode and its HMAC, or is a library that was
installed with the package, as its Python code was.
"""

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from jaxbeam.runtime.cache_folder import (
    LIBRARY_PREFIX,
    CacheError,
    cache_folder,
    machine_description,
    private_folder,
    read_file,
    temporary_file,
    write_file,
)

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


LOGGER = logging.getLogger(__name__)
C_FOLDER = pathlib.Path(__file__).parent / "native"
# Functions that are called once are not made part of their callers: the compiler takes a third less
# time, and the code runs as fast.
COMPILER_FLAGS = (
    *("-O2", "-fno-inline-functions-called-once", "-fno-math-errno"),
    *(
        () if sys.platform == "win32" else ("-fPIC",)
    ),  # there all code is so; clang refuses the word
)


class Library(NamedTuple):
    """A C library: file names in C_FOLDER, or the text of its only file.

    It is compiled for an architecture, as compilers name it.
    """

    sources: tuple[str, ...]
    headers: tuple[str, ...]
    text: str | None = None
    architecture: str = "native"

    @property
    def compiler_flags(self) -> tuple[str, ...]:
        """Arguments of the compiler, without the sources."""
        own = () if self.text is None else ("-I", str(C_FOLDER), "-O1")
        return (*COMPILER_FLAGS, f"-march={self.architecture}", *own)

    @property
    def file_name(self) -> str:
        """Name of the compiled library in the cache folder."""
        return f"{LIBRARY_PREFIX}{_fingerprint(self)}"

    def library_path(self) -> pathlib.Path:
        """Path of the compiled library, built or not. Raises CacheError without a cache folder."""
        return cache_folder() / self.file_name

    def build(self) -> pathlib.Path:
        """Compile the library for this machine; its path.

        Raises RuntimeError if there is no C compiler, it fails, or the cache folder cannot be used.
        """
        try:
            with tempfile.TemporaryDirectory(dir=private_folder()) as folder:
                compiled = pathlib.Path(folder) / "library.so"
                _compile(self, compiled)
                path = write_file(self.file_name, compiled.read_bytes())
                LOGGER.info("C code compiled by %s: %s", find_compiler(), path)
                return path
        except (CacheError, OSError) as error:
            raise RuntimeError(f"the C code cannot be stored: {error}") from None

    def can_be_built(self) -> bool:
        """Whether there is a compiler, and no library: in the wheel, compiled here or removed."""
        try:
            if os.path.lexists(self.library_path()) or self.available():
                return False
        except CacheError:
            return False
        if find_compiler() is None:
            LOGGER.info("C code not used: there is no C compiler")
            return False
        return True

    @contextlib.contextmanager
    def built_meanwhile(self) -> Iterator[None]:
        """Context in which the library is compiled in another thread, if it can be.

        At its end the library is `available`, unless compilation failed, which raises nothing.
        """
        if not self.can_be_built():
            yield
            return
        with ThreadPoolExecutor(1) as pool:
            build = pool.submit(self.build)
            yield
            try:
                build.result()
            except RuntimeError as error:
                LOGGER.info("C code not used: %s", error)

    def remove(self) -> pathlib.Path:
        """Remove the compiled library until `build`; its path, of an empty file in its place.

        Raises RuntimeError if that fails.
        """
        try:
            return write_file(self.file_name, b"")
        except (CacheError, OSError) as error:
            raise RuntimeError(f"the C code cannot be removed: {error}") from None

    def available(self) -> bool:
        """Whether the library is compiled, authentic and loadable, or came with the wheel.

        Warns of a library that is refused.
        """
        try:
            status = self.library_path().lstat()
        except (CacheError, OSError):
            return self.text is None and _in_wheel(C_FOLDER) is not None
        return _is_usable(self, self.library_path(), status.st_ctime_ns, status.st_size)

    def load(self) -> NativeCode:
        """The library; only where it is `available`."""
        return _load(self).code

    def loaded_architecture(self) -> str:
        """Architecture of the library; only where it is `available`.

        Code that the library calls is compiled for the same one, with registers of the same width.
        """
        return _load(self).architecture


class Loaded(NamedTuple):
    """A loaded library, and the architecture that it was compiled for."""

    code: NativeCode
    architecture: str


def find_compiler() -> str | None:
    """Command of the C compiler: that in CC, else cc, gcc or clang; None if there is none."""
    found = (shutil.which(name) for name in ("cc", "gcc", "clang"))
    return os.environ.get("CC") or next(filter(None, found), None)


def _compile(library: Library, target: pathlib.Path) -> None:
    """Compile the files of a library, all at once, and link them.

    At once, the four files of the integrator take 0.65 s on two cores; as one file they took 1.9 s.
    Raises RuntimeError with the compiler's message.
    """
    command = find_compiler()
    if command is None:
        raise RuntimeError("there is no C compiler here: install gcc or clang, or name one in CC")

    def compile_file(name: str) -> str:
        source, compiled = str(C_FOLDER / name), str(target.with_name(f"{name}.o"))
        _run_compiler(command, ["-c", source, *library.compiler_flags, "-o", compiled], source)
        return compiled

    if library.text is not None:
        written = target.with_name("program.c")
        written.write_text(library.text)
        arguments = [str(written), "-shared", *library.compiler_flags, "-lm", "-o", str(target)]
        return _run_compiler(command, arguments, str(written))
    with ThreadPoolExecutor() as pool:
        parts = list(pool.map(compile_file, library.sources))
    _run_compiler(command, ["-shared", *parts, "-o", str(target)], " ".join(parts))


def _run_compiler(command: str, arguments: list[str], what: str) -> None:
    """Run a C compiler. Raises RuntimeError with its message."""
    try:
        process = subprocess.run([*command.split(), *arguments], capture_output=True, text=True)
    except OSError as error:
        raise RuntimeError(f"the C compiler {command} cannot be run: {error}") from None
    if process.returncode or not pathlib.Path(arguments[-1]).exists():
        message = process.stderr.strip()[-500:]
        raise RuntimeError(f"the C compiler {command} cannot compile {what}: {message}")


@functools.cache
def _is_usable(library: Library, path: pathlib.Path, changed: int, size: int) -> bool:
    """Whether a library file is authentic and loads; examined once unless the file changes."""
    try:
        return bool(read_file(path.name)) and bool(_load(library))  # an empty one was removed
    except (CacheError, OSError) as error:
        warnings.warn(f"C code not used: {error}; `jaxbeam native` compiles it anew", stacklevel=2)
        return False


@functools.cache
def _load(library: Library) -> Loaded:
    """Load a library, once a process: that of the cache folder, or else of the wheel."""
    compiled_here = True
    with contextlib.suppress(CacheError):
        compiled_here = os.path.lexists(library.library_path())
    of_wheel = None if compiled_here or library.text is not None else _in_wheel(C_FOLDER)
    return of_wheel or Loaded(loaded_library(library.file_name), library.architecture)


@functools.cache
def _in_wheel(folder: pathlib.Path) -> Loaded | None:
    """The library that came with the wheel for this processor; None without one that loads."""
    found = sorted((folder / "compiled").glob(f"{source_hash(folder)}-*"))
    loaded = None
    try:
        for path in found:  # the least architecture first, whose code tells if the next runs here
            if loaded is None or loaded.code.runs_x86_64_v3():
                architecture = path.stem.partition("-")[2]
                loaded = Loaded(library_of_wheel(path), architecture)
    except OSError as error:
        LOGGER.info("C code of the wheel not used: %s", error)
    return loaded


def source_hash(folder: pathlib.Path) -> str:
    """Hash of all C files of a folder, by which wheels name what was compiled of them."""
    texts = (path.read_bytes() for path in sorted(folder.glob("*.[ch]")))
    return hashlib.sha256(b"".join(texts)).hexdigest()[:16]


@functools.cache
def _fingerprint(library: Library) -> str:
    """Hash of source, compiler flags and machine."""
    texts = [(C_FOLDER / name).read_text() for name in library.sources + library.headers]
    texts.append(library.text or "")
    parts = [*texts, *library.compiler_flags, machine_description()]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
