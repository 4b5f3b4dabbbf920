"""Files that are whole or not there: written beside their place, and moved to it at the end."""

import contextlib
import contextvars
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

# Names of the files written in a context that asks for them, as a command that is interrupted.
WRITTEN: contextvars.ContextVar[list[str] | None] = contextvars.ContextVar("written", default=None)


@contextlib.contextmanager
def whole_file(path: str | os.PathLike, overwrite: bool = False) -> Iterator[Path]:
    """Path at which to write the file or folder that takes the place of `path` at the end.

    A write that is stopped leaves what was there. Raises FileExistsError if something is there,
    without `overwrite`; OSError (a FileNotFoundError without its folder) with the name `path`,
    whatever cannot be written.
    """
    place = Path(os.path.realpath(path))  # a link stays a link
    _refuse_existing(place, path, overwrite)
    beside = place.with_name(f".{place.stem}.{os.getpid()}{place.suffix}")
    try:
        with naming_file(path):
            if not place.parent.is_dir():
                raise FileNotFoundError(None, f"there is no folder {Path(path).parent}")
            yield beside
            _refuse_existing(place, path, overwrite)  # of another process meanwhile
            if place.is_dir():
                shutil.rmtree(place)
            os.replace(beside, place)
    finally:
        with contextlib.suppress(OSError):
            if beside.is_dir():
                shutil.rmtree(beside)
            beside.unlink(missing_ok=True)
    if (written := WRITTEN.get()) is not None:
        written.append(os.fspath(path))


@contextlib.contextmanager
def naming_file(path: str | os.PathLike, kept: str = "") -> Iterator[None]:
    """Replace errors of the system in writing by one sentence with the name that the user gave.

    `kept` says what is there all the same, and how to go on. Raises OSError of the same class.
    """
    try:
        yield
    except FileExistsError:
        raise
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else error.strerror or str(error)
        kind = type(error) if type(error).__module__ == "builtins" else OSError
        named = kind(f"cannot write {os.fspath(path)}: {reason[:1].lower()}{reason[1:]}{kept}")
        named.errno = error.errno
        raise named from None


def _refuse_existing(place: Path, path: str | os.PathLike, overwrite: bool) -> None:
    if place.exists() and not overwrite:
        raise FileExistsError(
            f"{os.fspath(path)} exists already; choose another name, or overwrite it"
        )
