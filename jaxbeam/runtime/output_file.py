"""Files that are written: their endings; whole or not there; locked while one process writes them.

A lock outlives the crash of its process and is then taken over: on the same machine when no process
of that number and start time is left, from other machines when its last sign of life (the time of
the file, set by a thread) is older than MAX_SILENCE. Times are those of the file system, so that
clocks of the machines may differ.
"""

import contextlib
import contextvars
import datetime
import importlib.util
import json
import os
import platform
import shutil
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jaxbeam.runtime.cache_folder import link, temporary_file

# Names of the files written in a context that asks for them, as a command that is interrupted.
WRITTEN: contextvars.ContextVar[list[str] | None] = contextvars.ContextVar("written", default=None)


@contextlib.contextmanager
def whole_file(path: str | os.PathLike, overwrite: bool = False) -> Iterator[Path]:
    """Path at which to write the file or folder that takes the place of `path` at the end.

    A write that is stopped leaves what was there. Raises FileExistsError if something is there,
    without `overwrite`, or a folder, which is replaced by a folder only if it is a store of Zarr;
    OSError (a FileNotFoundError without its folder) with the name `path`, whatever cannot be
    written, or is a device or a pipe, which a file would take the place of; ValueError for an
    empty name, which is that of the folder.
    """
    check_named(path)
    place = Path(os.path.realpath(path))  # a link stays a link
    _refuse_existing(place, path, overwrite)
    # The ending is that of the name, which decides the format, and not that of the file behind.
    partial = place.with_name(f".{place.stem}.{os.getpid()}{Path(path).suffix}")
    try:
        with naming_file(path):
            if not place.parent.is_dir():
                raise FileNotFoundError(None, f"there is no folder {Path(path).parent}")
            if place.exists() and not (place.is_file() or place.is_dir()):
                raise OSError(None, "it is a device or a pipe, not a regular file")
            yield partial
            _refuse_existing(place, path, overwrite)  # of another process meanwhile
            if place.is_dir():
                refuse_folder(place, path, by_file=partial.is_file())
                shutil.rmtree(place)
            os.replace(partial, place)
    finally:
        with contextlib.suppress(OSError):
            if partial.is_dir():
                shutil.rmtree(partial)
            partial.unlink(missing_ok=True)
    if (written := WRITTEN.get()) is not None:
        written.append(os.fspath(path))


def check_named(path: str | os.PathLike) -> None:
    """Raises ValueError for the name of a file to write that is empty, or a folder's."""
    if not Path(path).name:
        raise ValueError(f"{os.fspath(path)!r} is no name of a file to write; give it one")


@contextlib.contextmanager
def naming_file(path: str | os.PathLike, kept: Callable[[], str] = str) -> Iterator[None]:
    """Replace errors of the system in writing by one sentence with the name that the user gave.

    `kept()` says what is there all the same, and how to go on. Raises OSError of the same class.
    """
    try:
        yield
    except FileExistsError:
        raise
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else error.strerror or str(error)
        kind = type(error) if type(error).__module__ == "builtins" else OSError
        named = kind(f"cannot write {os.fspath(path)}: {reason[:1].lower()}{reason[1:]}{kept()}")
        named.errno = error.errno
        raise named from None


def _refuse_existing(place: Path, path: str | os.PathLike, overwrite: bool) -> None:
    if place.exists() and not overwrite:
        raise FileExistsError(
            f"{os.fspath(path)} exists already; choose another name, or overwrite it"
        )
    refuse_folder(place, path)


def refuse_folder(place: Path, path: str | os.PathLike, by_file: bool = False) -> None:
    """Raises FileExistsError for a folder in whose place nothing is written: it may hold anything.

    A store of Zarr and an empty folder may be replaced, but not `by_file`. `place` is `path`, with
    links followed.
    """
    if not place.is_dir():
        return
    is_store = any((place / name).is_file() for name in ("zarr.json", ".zgroup"))
    if by_file or not (is_store or next(place.iterdir(), None) is None):
        raise FileExistsError(f"{os.fspath(path)} is a folder, not a file; choose another name")


TABLES = (".csv", ".xlsx", ".mat", ".parquet")  # columns of numbers with heads
DATASETS = (".nc", ".zarr")  # everything, with units and coordinates
RESULTS = (*DATASETS, *TABLES)
PACKAGES = {".xlsx": "openpyxl", ".parquet": "pyarrow"}


def check_ending(path: str | os.PathLike, content: str, allowed: tuple[str, ...] = RESULTS) -> None:
    """Check that a result can be written to a file by its ending.

    Raises ValueError for no name, or another ending than those allowed; ImportError, with what to
    install, if the package that writes it is missing.
    """
    check_named(path)
    ending = Path(path).suffix
    if ending not in allowed:
        first = Path(path).with_suffix(allowed[0])
        more = [one for one in dict.fromkeys(allowed) if one != allowed[0]]
        others = f", or {', '.join(more)}" if more else ""
        raise ValueError(f"{content} is written to a {allowed[0]} file; call it {first}{others}")
    package = PACKAGES.get(ending, "")
    if package and importlib.util.find_spec(package) is None:
        raise ImportError(
            f"{ending} files need {package}, which is not installed: pip install {package}, or"
            " 'jaxbeam[tables]'"
        )


SIGN_OF_LIFE = 10.0  # s, between two signs of life
MAX_SILENCE = 120.0  # s, after which a process of another machine counts as gone


class InUseError(OSError):
    """Error that says which process writes a file, and what to do."""


@contextlib.contextmanager
def writer_lock(path: Path) -> Iterator[None]:
    """Hold the lock of a path, which need not exist, in a file `.NAME.lock` in its folder.

    Raises InUseError if another process (or thread) holds it, OSError if the folder cannot be
    written to.
    """
    lock = lock_file(path)
    content = json.dumps(_this_process()).encode()
    while not _acquire(path, lock, content):
        time.sleep(0.01)
    ended = threading.Event()
    thread = threading.Thread(target=_give_signs_of_life, args=(lock, ended), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        with contextlib.suppress(FileNotFoundError):
            if lock.read_bytes() == content:
                lock.unlink()


def lock_file(path: Path) -> Path:
    """Path of the lock of a path."""
    return path.with_name(f".{path.name}.lock")


def _acquire(path: Path, lock: Path, content: bytes) -> bool:
    """Take a lock that is free, or whose process is gone; False if another does so just now."""
    with temporary_file(path.parent, content) as own:
        os.chmod(own, 0o644)  # others may read who holds it
        if _link(own, lock, content):
            return True
        held, silence = _content_and_silence(lock, os.stat(own).st_mtime)
        if held is None:  # released in between
            return False
        if _holder_lives(held, silence):
            raise InUseError(_description(path, lock, held, silence))
        return _take_over(own, lock, content, held)


def _take_over(own: str, lock: Path, content: bytes, held: bytes) -> bool:
    """Take the lock of a process that is gone; False if another process does so just now.

    One process at a time may: that which has the file `.takeover`.
    """
    takeover = lock.with_name(f"{lock.name}.takeover")
    if not _link(own, takeover, content):
        other, silence = _content_and_silence(takeover, os.stat(own).st_mtime)
        if other is not None and not _holder_lives(other, silence):
            takeover.unlink(missing_ok=True)
        return False
    try:
        if _content_and_silence(lock, 0.0)[0] != held:
            return False
        os.replace(own, lock)
        return True
    finally:
        takeover.unlink(missing_ok=True)


def _link(own: str, target: Path, content: bytes) -> bool:
    """Give a file a second name; False if there is a file of this name."""
    try:
        link(own, target, content)
    except FileExistsError:
        return False
    return True


def _content_and_silence(lock: Path, now: float) -> tuple[bytes | None, float]:
    """Content of a lock (None without one), and the time since its last sign of life, in s."""
    try:
        return lock.read_bytes(), now - lock.stat().st_mtime
    except FileNotFoundError:
        return None, 0.0


def _holder(held: bytes) -> dict[str, Any]:
    """Content of a lock, which identifies its process; empty if it is damaged."""
    try:
        content = json.loads(held)
        return content if isinstance(content, dict) else {}
    except ValueError:
        return {}


def _holder_lives(held: bytes, silence: float) -> bool:
    """Whether the process that holds a lock lives, as far as can be known from here."""
    holder = _holder(held)
    machine = _machine()
    if machine is not None and holder.get("machine") == machine:
        start = _start_time(holder.get("process", 0))
        return start is not None and start == holder.get("start")
    return silence < MAX_SILENCE


def _give_signs_of_life(lock: Path, ended: threading.Event) -> None:
    """Set the time of a lock until the end."""
    while not ended.wait(SIGN_OF_LIFE):
        with contextlib.suppress(OSError):
            os.utime(lock)


def _this_process() -> dict[str, Any]:
    """Content of a lock of this process, unique for each time that it is held."""
    return {
        "host": platform.node(),
        "process": os.getpid(),
        "since": datetime.datetime.now().astimezone().isoformat(" ", "seconds"),
        "machine": _machine(),
        "start": _start_time(os.getpid()),
        "token": uuid.uuid4().hex,
    }


def _machine() -> str | None:
    """Identifier of machine, boot and container; None if process times are unknown.

    A host name is not enough: two machines may have the same.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return None


def _start_time(process: int) -> int | None:
    """Start time of a running process of this machine, in clock ticks; None if it has ended."""
    try:
        # The name of the program, in parentheses, may contain anything.
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else int(fields[19])


def _description(path: Path, lock: Path, held: bytes, silence: float) -> str:
    """Who holds a lock, and what to do."""
    holder = _holder(held)
    who = "another process"
    if holder:
        who = f"process {holder.get('process')} on {holder.get('host')} since {holder.get('since')}"
    return (
        f"{path} is being written by {who} (last sign of life {max(silence, 0):.0f} s ago): wait"
        " until it ends, stop it, or choose another name; if it was killed on another machine,"
        f" its lock {lock} ends {MAX_SILENCE:.0f} s after the last sign of life"
    )
