"""Files that are whole or not there: written beside their place, and moved to it at the end."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def whole_file(path: str | os.PathLike, overwrite: bool = False) -> Iterator[Path]:
    """Path at which to write the file or folder that takes the place of `path` at the end.

    A write that is stopped leaves what was there. Raises FileExistsError if something is there,
    without `overwrite`.
    """
    place = Path(os.path.realpath(path))  # a link stays a link
    _refuse_existing(place, path, overwrite)
    beside = place.with_name(f".{place.stem}.{os.getpid()}{place.suffix}")
    try:
        yield beside
        _refuse_existing(place, path, overwrite)  # of another process meanwhile
        if place.is_dir():
            shutil.rmtree(place)
        os.replace(beside, place)
    finally:
        if beside.is_dir():
            shutil.rmtree(beside)
        beside.unlink(missing_ok=True)


def _refuse_existing(place: Path, path: str | os.PathLike, overwrite: bool) -> None:
    if place.exists() and not overwrite:
        raise FileExistsError(
            f"{os.fspath(path)} exists already; choose another name, or overwrite it"
        )
