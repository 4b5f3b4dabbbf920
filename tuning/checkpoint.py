"""The state of a long search on disk, so that it survives whatever stops it."""

import hashlib
import json
import os
import zipfile
from pathlib import Path

import numpy as np


def fingerprint(description: dict) -> str:
    """A short name of all that decides a search, to tell one search from another."""
    text = json.dumps(description, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def save(path: Path, digest: str, arrays: dict[str, np.ndarray]) -> None:
    """Write named arrays, all of them or, if stopped while at it, none."""
    part = path.with_name(path.name + ".part")
    with open(part, "wb") as file:
        np.savez(file, fingerprint=np.array(digest), **arrays)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def load(path: Path, digest: str) -> dict[str, np.ndarray]:
    """Read what `save` wrote. Raises ValueError if it is damaged, or of another search."""
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError):
        raise ValueError(f"{path} is damaged: delete it to start anew") from None
    if str(arrays.pop("fingerprint", "")) != digest:
        raise ValueError(
            f"{path} belongs to another search (other case, numbers, runs or settings): delete it"
            " to start anew, or name another file"
        )
    return arrays
