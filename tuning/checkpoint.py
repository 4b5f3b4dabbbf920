"""Checkpoints: the state of a long search on disk, from which a stopped search goes on."""

import contextlib
import dataclasses
import hashlib
import io
import json
import os
import zipfile
from pathlib import Path

import numpy as np

from jaxbeam.runtime.input_file import check_input, max_bytes, not_as_named
from jaxbeam.runtime.interrupts import keeping
from jaxbeam.runtime.output_file import whole_file


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """File with the state of one search; without a path nothing is written or read.

    `digest` is the `fingerprint` of the search, kept in the file.
    """

    path: Path | None = None
    digest: str = ""

    def load(self) -> dict[str, np.ndarray] | None:
        """Arrays of the state, None if there is no file yet.

        Raises ValueError if the file is damaged or belongs to another search.
        """
        return load(self.path, self.digest) if self.path and self.path.exists() else None

    def save(self, arrays: dict[str, np.ndarray]) -> None:
        """Write the arrays of the state."""
        if self.path is not None:
            save(self.path, self.digest, arrays)


NO_CHECKPOINT = Checkpoint()


def kept_in(*paths: Path | None) -> contextlib.AbstractContextManager[None]:
    """Work whose state is kept in checkpoints, if it is interrupted, from which it is resumed."""

    def sentence() -> str:
        names = [os.fspath(path) for path in paths if path is not None and path.exists()]
        return f"the search is kept in {', '.join(names)}: resume it, with --resume" * bool(names)

    return keeping(sentence)


def checkpoint_path(checkpoint: str | os.PathLike | None, resume: bool) -> Path | None:
    """Path of a checkpoint.

    Raises FileExistsError if it exists and `resume` is not set, FileNotFoundError without its
    folder.
    """
    path = None if checkpoint is None else Path(checkpoint)
    if path is not None and path.exists() and not resume:
        raise FileExistsError(f"{path} exists: resume that search, or delete it")
    if path is not None and not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {path.parent}")
    return path


def fingerprint(description: dict) -> str:
    """Digest (16 hexadecimal digits) of all that decides a search."""
    text = json.dumps(description, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def save(
    path: str | os.PathLike, digest: str, arrays: dict[str, np.ndarray], overwrite: bool = True
) -> None:
    """Write named arrays to a file in one step: a stopped write leaves the file as it was.

    Raises FileExistsError if the file exists, without `overwrite`.
    """
    in_memory = io.BytesIO()  # closed before a full disk may end the write
    np.savez(in_memory, fingerprint=np.array(digest), **arrays)
    with whole_file(path, overwrite) as partial, open(partial, "wb") as file:
        file.write(in_memory.getbuffer())
        file.flush()
        os.fsync(file.fileno())


def load(path: Path, digest: str) -> dict[str, np.ndarray]:
    """Arrays written by `save`. Raises ValueError if damaged or written under another digest."""
    try:
        arrays = read_arrays(path, "checkpoint")
    except (OSError, ValueError) as error:
        raise ValueError(f"{error}; delete it to start anew") from None
    if str(arrays.pop("fingerprint", "")) != digest:
        raise ValueError(
            f"{path} belongs to another search (other case, parameters, runs or settings, or an"
            " older version of jaxbeam): delete it to start anew, or name another file"
        )
    return arrays


def read_arrays(path: Path, what: str) -> dict[str, np.ndarray]:
    """Arrays of a NumPy archive, by name; `what` it is to the user.

    Raises ValueError for a file that is no such archive, damaged or too large, also once it is
    unpacked; OSError if it cannot be read.
    """
    check_input(path, what)
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(part.file_size for part in archive.infolist())
        if unpacked <= max_bytes(what):
            with np.load(path, allow_pickle=False) as file:
                return {name: np.asarray(file[name]) for name in file.files}
    except Exception:  # NumPy and zipfile raise many types for damaged files
        raise not_as_named(path, "NumPy archive", b"PK") from None
    raise ValueError(f"{path} holds {unpacked / 2**30:.3g} GB, too much for a {what}")
