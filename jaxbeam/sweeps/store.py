"""Where the results of a long sweep are kept, block by block, so that an interruption costs little.

While a sweep runs, each block is one chunk of flat arrays in the group `blocks` of a zarr store,
written before the flag that says it is done. When all are done, the labelled dataset takes
their place; the store is complete from the moment at which the group is gone. A fingerprint of
everything that shapes the numbers guards against mixing sweeps.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX
    import zarr  # takes long to import; only sweeps that are kept need it

FINGERPRINT_ATTRIBUTE = "jaxbeam_sweep"
BLOCKS_GROUP = "blocks"
DAMAGE_ERRORS = (OSError, ValueError, KeyError, TypeError, RuntimeError)  # what zarr raises for it


@runtime_checkable
class BlockStore(Protocol):
    """Keeps finished blocks: in memory or on disk."""

    def missing(self) -> list[int]:
        """Numbers of the blocks that are not done."""
        ...

    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        """Keep the results of a block, arrays of the same shape for every block."""
        ...

    def collect(self) -> dict[str, np.ndarray]:
        """Results of all blocks, one after the other along the first axis."""
        ...

    def finish(self, dataset: xarray.Dataset) -> None:
        """Put the labelled dataset in the place of the blocks."""
        ...


class MemoryStore(BlockStore):
    """Keeps blocks in memory."""

    def __init__(self, blocks: int):
        self._blocks: list[dict[str, np.ndarray]] = [{} for _ in range(blocks)]

    def missing(self) -> list[int]:
        return [i for i, block in enumerate(self._blocks) if not block]

    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        self._blocks[block] = results

    def collect(self) -> dict[str, np.ndarray]:
        names = self._blocks[0]
        return {name: np.concatenate([block[name] for block in self._blocks]) for name in names}

    def finish(self, dataset: xarray.Dataset) -> None:
        pass


class ZarrStore(BlockStore):
    """Keeps blocks in a zarr store; `steps` is what `create_store` was given with them.

    Raises ValueError if it cannot be read.
    """

    def __init__(self, path: Path):
        import zarr

        self._path = path
        with _explaining_damage(path):
            self._blocks: Any = zarr.open_group(path, mode="r+")[BLOCKS_GROUP]
            self.steps = np.asarray(self._blocks["steps"][:])
            self._flags = self._blocks["done"]
            self._count = self._flags.shape[0]
        self._arrays: dict[str, Any] = {}  # opened once: to open one takes as long as to write

    def specification(self) -> dict[str, Any]:
        """What was ordered, as it was given to `create_store`."""
        with _explaining_damage(self._path):
            return json.loads(np.asarray(self._blocks["order"][:]).tobytes())

    def missing(self) -> list[int]:
        flagged = [block for block in range(self._count) if self._is_flagged(block)]
        damaged = [] if self._all_readable() else [b for b in flagged if not self._is_intact(b)]
        if damaged:
            warnings.warn(
                f"{self._path}: {len(damaged)} finished blocks are damaged and are computed again",
                stacklevel=3,
            )
        return sorted(set(range(self._count)) - set(flagged) | set(damaged))

    def is_done(self, block: int) -> bool:
        """Whether a block has been written."""
        return self._is_flagged(block) and self._is_intact(block)

    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        with _explaining_write_errors(self._path):
            for name, values in results.items():
                size = values.shape[0]
                self._result_array(name, values)[block * size : (block + 1) * size] = values
            self._flags[block] = True

    def collect(self) -> dict[str, np.ndarray]:
        with _explaining_damage(self._path):
            return {name: np.asarray(self._blocks[name][:]) for name in self._names()}

    def finish(self, dataset: xarray.Dataset) -> None:
        with _explaining_write_errors(self._path):
            # What an interrupted attempt has left may be incomplete.
            for folder in self._path.iterdir():
                if folder.is_dir() and folder.name != BLOCKS_GROUP:
                    shutil.rmtree(folder)
            # Words of fixed length have no settled place in the format, words of any length do.
            labels = dataset["sensor"].values.astype(object)
            dataset.assign_coords(sensor=labels).to_zarr(
                self._path,
                mode="a",
                consolidated=False,
                write_empty_chunks=True,
                encoding={name: {"compressors": _checksummed()} for name in dataset.variables},
            )
            # From here on the store is complete: a group is one by its description.
            (self._path / BLOCKS_GROUP / "zarr.json").unlink()
            shutil.rmtree(self._path / BLOCKS_GROUP)

    def _names(self) -> list[str]:
        return sorted(set(self._blocks.array_keys()) - {"done", "steps", "order"})

    def _result_array(self, name: str, values: np.ndarray) -> Any:
        """The array for all results of a name, created from those of the first block."""
        if name not in self._arrays:
            if name not in self._blocks:
                self._blocks.create_array(
                    name,
                    shape=(self._count * values.shape[0], *values.shape[1:]),
                    chunks=values.shape,
                    dtype=values.dtype,
                    **_array_options(),
                )
            self._arrays[name] = self._blocks[name]
        return self._arrays[name]

    def _is_flagged(self, block: int) -> bool:
        if not (self._path / BLOCKS_GROUP / "done" / "c" / str(block)).is_file():
            return False
        try:
            return bool(self._flags[block])
        except DAMAGE_ERRORS:
            return False

    def _all_readable(self) -> bool:
        """Whether all that is there can be read, found out quickly."""
        try:
            whole = all(_is_complete(self._blocks[name]) for name in self._names())
            return whole and bool(self.collect())
        except ValueError:
            return False

    def _is_intact(self, block: int) -> bool:
        """Whether all results of a block are there and can be read."""
        try:
            for name in self._names():
                array = self._blocks[name]
                size = array.chunks[0]
                chunk = Path("c", str(block), *["0"] * (array.ndim - 1))
                if not (self._path / BLOCKS_GROUP / name / chunk).is_file():
                    return False
                array[block * size : (block + 1) * size]
        except DAMAGE_ERRORS:
            return False
        return True


def read_dataset(path: Path) -> xarray.Dataset:
    """The dataset of a complete store. Raises ValueError if part of it is missing or damaged."""
    import xarray
    import zarr

    shutil.rmtree(path / BLOCKS_GROUP, ignore_errors=True)  # a kill may have left its chunks behind
    with _explaining_damage(path):
        group = zarr.open_group(path, mode="r")
        arrays: dict[str, Any] = {
            part.name: group[part.name] for part in path.iterdir() if part.is_dir()
        }
        incomplete = [name for name, array in arrays.items() if not _is_complete(array)]
        if incomplete:
            raise ValueError(f"parts of {', '.join(sorted(incomplete))} are missing")
        return xarray.open_zarr(path, consolidated=False).load()


def _checksummed():
    from zarr.codecs import ZstdCodec

    return [ZstdCodec(checksum=True)]


def _array_options() -> dict[str, Any]:
    """How arrays are written so that what is damaged or missing can be told."""
    return {"compressors": _checksummed(), "config": {"write_empty_chunks": True}}


def _is_complete(array: zarr.Array) -> bool:
    """Whether every chunk of an array is there: zarr reads those that are not as zeros."""
    return array.nchunks_initialized == array.nchunks


@contextlib.contextmanager
def _explaining_damage(path: Path):
    """Turn what damaged files make zarr raise into one sentence."""
    try:
        yield
    except DAMAGE_ERRORS as error:
        raise ValueError(
            f"{path} is damaged ({' '.join(str(error).split())}): make the sweep anew, under"
            " another name or with overwrite"
        ) from None


@contextlib.contextmanager
def _explaining_write_errors(path: Path):
    """Say in one sentence what kept a sweep from being written, and that nothing is lost."""
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise type(error)(
            f"cannot write to {path}: {reason}; what is done is kept: mend this, then resume"
        ) from None


def status(path: Path) -> tuple[str, str] | None:
    """Status ("unfinished", "complete") and fingerprint of the sweep at a path, None without one.

    Raises FileExistsError if something else is there.
    """
    import zarr

    if not path.exists():
        return None
    try:
        fingerprint = str(zarr.open_group(path, mode="r").attrs[FINGERPRINT_ATTRIBUTE])
    except (KeyError, OSError, ValueError):
        raise FileExistsError(
            f"{path} exists and is not a sweep of jaxbeam; choose another name"
        ) from None
    unfinished = (path / BLOCKS_GROUP / "zarr.json").exists()
    return "unfinished" if unfinished else "complete", fingerprint


def resolve_action(path: Path, fingerprint: str, resume: bool, overwrite: bool) -> str:
    """Decide what to do about a path: "new", "resume" or "complete"; nothing is changed there.

    Raises FileExistsError if a sweep is there and neither `resume` nor `overwrite` is set, and
    ValueError if both are, or if it was made from other numbers than are to be resumed.
    """
    if resume and overwrite:
        raise ValueError("resume continues a sweep, overwrite discards it; choose one of them")
    existing = status(path)
    if existing is None or overwrite:
        check_writable(path)
        return "new"
    if not resume:
        raise FileExistsError(
            f"{path} holds a sweep already ({existing[0]}); resume it, overwrite it, or choose "
            "another name"
        )
    if existing[1] != fingerprint:
        raise ValueError(
            f"{path} holds a sweep of another case, other values or settings, or by another"
            " version (steps that `jaxbeam native` has compiled are one): it cannot be resumed with"
            " these; choose another name, or overwrite it"
        )
    return "complete" if existing[0] == "complete" else "resume"


def check_writable(path: Path) -> None:
    """Raises OSError, before any work, if nothing can be written beside a path."""
    try:
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise type(error)(
            f"cannot write {path.name} to the folder {path.parent}: {reason}"
        ) from None


def create_store(
    path: Path,
    fingerprint: str,
    specification: dict[str, Any],
    blocks: int,
    steps: np.ndarray,
    overwrite: bool = False,
) -> ZarrStore:
    """Start a store for a number of blocks; `steps` (s) are the time steps of the tasks.

    What was ordered, in plain words and numbers, is kept with them. With `overwrite` what is at
    the path gives way.
    """
    import zarr

    # Built aside and moved into place: a store either exists whole or not at all.
    temporary_path = path.with_name(f".{path.name}.new")
    shutil.rmtree(temporary_path, ignore_errors=True)
    with _explaining_write_errors(path):
        group = zarr.create_group(temporary_path)
        blocks_group = group.create_group(BLOCKS_GROUP)
        blocks_group.create_array(
            "done", shape=(blocks,), chunks=(1,), dtype=bool, fill_value=False
        )
        blocks_group.create_array(
            "steps", data=np.asarray(steps, float), compressors=_checksummed()
        )
        specification_bytes = np.frombuffer(json.dumps(specification).encode(), np.uint8)
        blocks_group.create_array("order", data=specification_bytes, compressors=_checksummed())
        group.attrs[FINGERPRINT_ATTRIBUTE] = fingerprint
        if overwrite:
            shutil.rmtree(path, ignore_errors=True)
        temporary_path.rename(path)
    return ZarrStore(path)
