"""Hand-written C, compiled for this machine when asked for, and found by later processes.

A library lies in the user's cache folder under a name that tells its sources, the machine and the
version of JAX. Functions that are called by XLA are its targets. Nobody needs it.
"""

import ctypes
import functools
import hashlib
import os
import pathlib
import shutil
import subprocess
import tempfile
from typing import NamedTuple

import jax

from jaxbeam.runtime.compile_cache import cache_folder, machine

HERE = pathlib.Path(__file__).parent / "native"
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC")


class Library(NamedTuple):
    """A library: its sources and headers, numbers that the C is told, and functions for XLA."""

    name: str
    sources: tuple[str, ...]
    headers: tuple[str, ...]
    constants: tuple[tuple[str, float], ...]
    targets: tuple[str, ...]

    @property
    def flags(self) -> tuple[str, ...]:
        """What the compiler is told, beside the sources."""
        return (*FLAGS, *(f"-D{name}={value}" for name, value in self.constants))

    def binary(self) -> pathlib.Path:
        """Where the compiled C is, or would be: a file for this C, this machine and this JAX."""
        return cache_folder() / f"{self.name}-{_mark(self)}.so"

    def target(self, name: str) -> str:
        """The name under which XLA knows a function of the library."""
        return f"jaxbeam_{name}_{_mark(self)}"

    def build(self) -> pathlib.Path:
        """Compile the C for this machine and return the library's path.

        Raises RuntimeError without a C compiler, or with what it complains of; OSError if the cache
        folder cannot be written.
        """
        command = compiler()
        if command is None:
            raise RuntimeError(
                "there is no C compiler here: install gcc or clang, or name one in CC"
            )
        target = self.binary()
        target.parent.mkdir(parents=True, exist_ok=True)
        sources = [str(HERE / name) for name in self.sources]
        # Made beside its place and moved there, so that nobody ever loads half of it.
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            made = pathlib.Path(folder) / target.name
            words = [*command.split(), *sources, *self.flags, "-I", jax.ffi.include_dir()]
            try:
                done = subprocess.run([*words, "-o", str(made)], capture_output=True, text=True)
            except OSError as error:
                raise RuntimeError(f"the C compiler {command} cannot be run: {error}") from None
            if done.returncode or not made.exists():
                said = done.stderr.strip()[-500:]
                raise RuntimeError(
                    f"the C compiler {command} cannot compile {' '.join(sources)}: {said}"
                )
            _digest(target).write_text(hashlib.sha256(made.read_bytes()).hexdigest())
            os.replace(made, target)
        return target

    def remove(self) -> None:
        """Remove what was compiled for this machine, if it was."""
        for path in (self.binary(), _digest(self.binary())):
            path.unlink(missing_ok=True)

    def ready(self) -> bool:
        """Whether the C is compiled for this machine, and of use: computing on a CPU."""
        path = self.binary()
        try:
            about = path.stat()
        except OSError:
            return False
        sound = _sound(path, about.st_mtime_ns, about.st_size)
        return jax.default_backend() == "cpu" and sound and bool(_loaded(self))

    def loaded(self) -> ctypes.CDLL:
        """The library, of whose functions XLA has been told; only if it is `ready`."""
        return _loaded(self)


def compiler() -> str | None:
    """The C compiler of this machine: that named in CC, or cc, gcc or clang, if there is one."""
    found = (shutil.which(name) for name in ("cc", "gcc", "clang"))
    return os.environ.get("CC") or next(filter(None, found), None)


@functools.cache
def _sound(path: pathlib.Path, written: int, size: int) -> bool:
    """Whether a library is undamaged: to load one that is not would end the process.

    Looked into once for what was written then.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() == _digest(path).read_text()
    except OSError:
        return False


@functools.cache
def _loaded(library: Library) -> ctypes.CDLL:
    """Load a library and tell XLA of it, which takes each name once in a process."""
    loaded = ctypes.CDLL(str(library.binary()))
    for name in library.targets:
        jax.ffi.register_ffi_target(library.target(name), jax.ffi.pycapsule(getattr(loaded, name)))
    return loaded


def _digest(path: pathlib.Path) -> pathlib.Path:
    """Where the check value of a library is."""
    return path.with_suffix(".sha256")


@functools.cache
def _mark(library: Library) -> str:
    """A number for the C, the machine and JAX."""
    written = [(HERE / name).read_text() for name in library.sources + library.headers]
    marks = [*written, *library.flags, jax.__version__, machine()]
    return hashlib.sha256("\n".join(marks).encode()).hexdigest()[:16]
