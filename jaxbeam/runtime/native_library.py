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

from jaxbeam.runtime.compile_cache import cache_folder, machine_description

C_FOLDER = pathlib.Path(__file__).parent / "native"
COMPILER_FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC")


class Library(NamedTuple):
    """A library: its sources and headers, numbers that the C is told, and functions for XLA."""

    name: str
    sources: tuple[str, ...]
    headers: tuple[str, ...]
    constants: tuple[tuple[str, float], ...]
    targets: tuple[str, ...]

    @property
    def compiler_flags(self) -> tuple[str, ...]:
        """What the compiler is told, beside the sources."""
        return (*COMPILER_FLAGS, *(f"-D{name}={value}" for name, value in self.constants))

    def library_path(self) -> pathlib.Path:
        """Where the compiled C is, or would be: a file for this C, this machine and this JAX."""
        return cache_folder() / f"{self.name}-{_fingerprint(self)}.so"

    def ffi_name(self, name: str) -> str:
        """The name under which XLA knows a function of the library."""
        return f"jaxbeam_{name}_{_fingerprint(self)}"

    def build(self) -> pathlib.Path:
        """Compile the C for this machine and return the library's path.

        Raises RuntimeError without a C compiler, or with what it complains of; OSError if the cache
        folder cannot be written.
        """
        command = find_compiler()
        if command is None:
            raise RuntimeError(
                "there is no C compiler here: install gcc or clang, or name one in CC"
            )
        target = self.library_path()
        target.parent.mkdir(parents=True, exist_ok=True)
        sources = [str(C_FOLDER / name) for name in self.sources]
        # Made beside its place and moved there, so that nobody ever loads half of it.
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            temporary_file = pathlib.Path(folder) / target.name
            command_line = [
                *command.split(),
                *sources,
                *self.compiler_flags,
                "-I",
                jax.ffi.include_dir(),
            ]
            try:
                process = subprocess.run(
                    [*command_line, "-o", str(temporary_file)], capture_output=True, text=True
                )
            except OSError as error:
                raise RuntimeError(f"the C compiler {command} cannot be run: {error}") from None
            if process.returncode or not temporary_file.exists():
                error_text = process.stderr.strip()[-500:]
                raise RuntimeError(
                    f"the C compiler {command} cannot compile {' '.join(sources)}: {error_text}"
                )
            _digest_path(target).write_text(hashlib.sha256(temporary_file.read_bytes()).hexdigest())
            os.replace(temporary_file, target)
        return target

    def remove(self) -> None:
        """Remove what was compiled for this machine, if it was."""
        for path in (self.library_path(), _digest_path(self.library_path())):
            path.unlink(missing_ok=True)

    def available(self) -> bool:
        """Whether the C is compiled for this machine, and of use: computing on a CPU."""
        path = self.library_path()
        try:
            file_status = path.stat()
        except OSError:
            return False
        intact = _is_intact(path, file_status.st_mtime_ns, file_status.st_size)
        return jax.default_backend() == "cpu" and intact and bool(_load(self))

    def load(self) -> ctypes.CDLL:
        """The library, of whose functions XLA has been told; only if it is `available`."""
        return _load(self)


def find_compiler() -> str | None:
    """The C compiler of this machine: that named in CC, or cc, gcc or clang, if there is one."""
    found = (shutil.which(name) for name in ("cc", "gcc", "clang"))
    return os.environ.get("CC") or next(filter(None, found), None)


@functools.cache
def _is_intact(path: pathlib.Path, modified: int, size: int) -> bool:
    """Whether a library is undamaged: to load one that is not would end the process.

    Looked into once for what was written then.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() == _digest_path(path).read_text()
    except OSError:
        return False


@functools.cache
def _load(library: Library) -> ctypes.CDLL:
    """Load a library and tell XLA of it, which takes each name once in a process."""
    loaded = ctypes.CDLL(str(library.library_path()))
    for name in library.targets:
        jax.ffi.register_ffi_target(
            library.ffi_name(name), jax.ffi.pycapsule(getattr(loaded, name))
        )
    return loaded


def _digest_path(path: pathlib.Path) -> pathlib.Path:
    """Where the check value of a library is."""
    return path.with_suffix(".sha256")


@functools.cache
def _fingerprint(library: Library) -> str:
    """A number for the C, the machine and JAX."""
    texts = [(C_FOLDER / name).read_text() for name in library.sources + library.headers]
    parts = [*texts, *library.compiler_flags, jax.__version__, machine_description()]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
