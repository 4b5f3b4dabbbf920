"""Writing of a store: one sweep at a time, and no finished run is lost before others replace it.

A sweep that overwrites another writes to a folder `.NAME.new` beside it, which takes the place of
the other when the sweep is complete. Repeated after an interrupt it continues there.
"""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from jaxbeam.runtime.writer_lock import writer_lock
from jaxbeam.sweeps.stores.store import check_writable, status
from jaxbeam.sweeps.stores.zarr_files import explaining_write_errors


class Writing(NamedTuple):
    """Folder that a sweep writes to, and its state: "new", "resume" or "complete"."""

    folder: Path
    state: str


@contextlib.contextmanager
def writing(path: Path, fingerprint: str, resume: bool, overwrite: bool) -> Iterator[Writing]:
    """Hold the store at a path while a sweep is written, and put it there at the end.

    Nothing is locked or written if the sweep is to be resumed and is complete. Raises InUseError
    (an OSError) while another sweep writes there; FileExistsError if a sweep exists, without
    `resume` or `overwrite`; ValueError for both, or if the sweep to be resumed has another
    fingerprint; OSError if the folder cannot be written to.
    """
    if resume and overwrite:
        raise ValueError("resume continues a sweep, overwrite discards it; choose one of them")
    if resume and status(path) == ("complete", fingerprint):
        yield Writing(path, "complete")
        return
    check_writable(path)
    with writer_lock(path):
        _mend_swap(path)
        chosen = _choose(path, fingerprint, resume, overwrite)
        yield chosen
        if chosen.folder != path:
            _swap(path)


def _choose(path: Path, fingerprint: str, resume: bool, overwrite: bool) -> Writing:
    """Folder for a sweep, and its state. Raises as `writing` does."""
    existing, new = status(path), _new_folder(path)
    if existing is None:
        return Writing(path, "new")
    if (resume or overwrite) and _status_or_none(new) == ("unfinished", fingerprint):
        return Writing(new, "resume")
    if (resume or overwrite) and _status_or_none(new) == ("complete", fingerprint):
        return Writing(new, "complete")
    if overwrite:
        with explaining_write_errors(path):
            shutil.rmtree(new, ignore_errors=True)
        return Writing(new, "new")
    if not resume:
        raise FileExistsError(
            f"{path} holds a sweep already ({existing[0]}); resume it, overwrite it, or choose "
            "another name"
        )
    if existing[1] != fingerprint:
        raise ValueError(
            f"{path} holds a sweep of another case, other values or settings, or by another"
            " version: it cannot be resumed with these; choose another name, or overwrite it"
        )
    return Writing(path, "complete" if existing[0] == "complete" else "resume")


def _status_or_none(path: Path) -> tuple[str, str] | None:
    """Status of the sweep at a path (see `status`); None without one, or if it cannot be read."""
    try:
        return status(path)
    except FileExistsError:
        return None


def _swap(path: Path) -> None:
    """Put the new folder in the place of the old one, which is deleted."""
    old = _old_folder(path)
    with explaining_write_errors(path):
        shutil.rmtree(old, ignore_errors=True)
        path.rename(old)
        _new_folder(path).rename(path)
    shutil.rmtree(old, ignore_errors=True)


def _mend_swap(path: Path) -> None:
    """Complete a swap that was interrupted between its two steps."""
    old, new = _old_folder(path), _new_folder(path)
    if not path.exists() and old.exists():
        complete = (_status_or_none(new) or ("",))[0] == "complete"
        (new if complete else old).rename(path)
    if path.exists():
        shutil.rmtree(old, ignore_errors=True)


def _new_folder(path: Path) -> Path:
    return path.with_name(f".{path.name}.new")


def _old_folder(path: Path) -> Path:
    return path.with_name(f".{path.name}.old")
