"""Zarr store of a sweep, written block by block, so that an interrupted sweep can be resumed.

During a sweep each block is one chunk of flat arrays in the group `blocks`, written before its flag
in the array `done`. The labelled dataset then replaces the group; the store is complete when the
group is gone. A fingerprint of all that determines the results protects against mixing sweeps: the
arrays of blocks are in a group named by it, so that a worker that was left behind by an earlier
sweep at this path writes none of its blocks among those of another.
"""

from __future__ import annotations

import json
import shutil
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxbeam.files.netcdf import check_codecs
from jaxbeam.sweeps.stores.block_store import BlockStore
from jaxbeam.sweeps.stores.zarr_files import (
    BLOCKS_GROUP,
    DAMAGE_ERRORS,
    FINGERPRINT_ATTRIBUTE,
    array_options,
    blocks_mark,
    checksummed,
    explaining_damage,
    explaining_write_errors,
    is_complete,
    new_store,
    replace_blocks,
)

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX


class ZarrStore(BlockStore):
    """Store of blocks in zarr format; `steps` are those given to `create_store`.

    Raises ValueError if it cannot be read.
    """

    def __init__(self, path: Path):
        import zarr

        self._path = path
        with explaining_damage(path):
            check_codecs(path)
            group: Any = zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
            mark = blocks_mark(str(group.attrs[FINGERPRINT_ATTRIBUTE]))
            self._blocks: Any = group[BLOCKS_GROUP][mark]
            self._folder = path / BLOCKS_GROUP / mark
            self.steps = np.asarray(self._blocks["steps"][:])
            self._flags = self._blocks["done"]
            self._count = self._flags.shape[0]
        self._arrays: dict[str, Any] = {}  # opened once, as opening takes as long as writing

    def specification(self) -> dict[str, Any]:
        """Specification of the sweep, as given to `create_store`."""
        with explaining_damage(self._path):
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
        """Whether a block has been written and can be read."""
        return self._is_flagged(block) and self._is_intact(block)

    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        with explaining_write_errors(self._path):
            for name, values in results.items():
                size = values.shape[0]
                self._result_array(name, values)[block * size : (block + 1) * size] = values
            self._flags[block] = True

    def collect(self) -> dict[str, np.ndarray]:
        with explaining_damage(self._path):
            return {name: np.asarray(self._blocks[name][:]) for name in self._names()}

    def finish(self, dataset: xarray.Dataset) -> None:
        replace_blocks(self._path, dataset)

    def _names(self) -> list[str]:
        return sorted(set(self._blocks.array_keys()) - {"done", "steps", "order"})

    def _result_array(self, name: str, values: np.ndarray) -> Any:
        """Array of all results of a name, created with the shapes of the first block."""
        if name not in self._arrays:
            if name not in self._blocks:
                self._blocks.create_array(
                    name,
                    shape=(self._count * values.shape[0], *values.shape[1:]),
                    chunks=values.shape,
                    dtype=values.dtype,
                    **array_options(),
                )
            self._arrays[name] = self._blocks[name]
        return self._arrays[name]

    def _is_flagged(self, block: int) -> bool:
        if not (self._folder / "done" / "c" / str(block)).is_file():
            return False
        try:
            return bool(self._flags[block])
        except DAMAGE_ERRORS:
            return False

    def _all_readable(self) -> bool:
        """Whether all blocks can be read: a fast check before `_is_intact`."""
        try:
            complete = all(is_complete(self._blocks[name]) for name in self._names())
            return complete and bool(self.collect())
        except ValueError:
            return False

    def _is_intact(self, block: int) -> bool:
        """Whether all results of a block exist and can be read."""
        try:
            for name in self._names():
                array = self._blocks[name]
                size = array.chunks[0]
                chunk = Path("c", str(block), *["0"] * (array.ndim - 1))
                if not (self._folder / name / chunk).is_file():
                    return False
                array[block * size : (block + 1) * size]
        except DAMAGE_ERRORS:
            return False
        return True


def read_dataset(path: Path) -> xarray.Dataset:
    """Dataset of a complete store. Raises ValueError if part of it is missing or damaged."""
    import xarray
    import zarr

    shutil.rmtree(path / BLOCKS_GROUP, ignore_errors=True)  # chunks may remain after a kill
    with explaining_damage(path):
        check_codecs(path)
        group = zarr.open_group(path, mode="r", zarr_format=3, use_consolidated=False)
        arrays: dict[str, Any] = {
            part.name: group[part.name] for part in path.iterdir() if part.is_dir()
        }
        incomplete = [name for name, array in arrays.items() if not is_complete(array)]
        if incomplete:
            raise ValueError(f"parts of {', '.join(sorted(incomplete))} are missing")
        return xarray.open_zarr(path, consolidated=False, zarr_format=3).load()


def status(path: Path) -> tuple[str, str] | None:
    """Status ("unfinished", "complete") and fingerprint of the sweep at a path; None without one.

    Raises FileExistsError if the path is no sweep.
    """
    import zarr

    if not path.exists():
        return None
    try:
        group = zarr.open_group(path, mode="r", zarr_format=3, use_consolidated=False)
        fingerprint = str(group.attrs[FINGERPRINT_ATTRIBUTE])
    except (KeyError, OSError, ValueError):
        raise FileExistsError(
            f"{path} exists and is not a sweep of jaxbeam; choose another name"
        ) from None
    unfinished = (path / BLOCKS_GROUP / "zarr.json").exists()
    return "unfinished" if unfinished else "complete", fingerprint


def check_writable(path: Path) -> None:
    """Raises OSError if nothing can be written to the folder of a path."""
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
) -> ZarrStore:
    """New store for a number of blocks, with the specification of the sweep.

    `steps` are the step sizes (s) of the batches and the error estimate. Raises OSError if the
    store cannot be written.
    """
    with new_store(path, fingerprint) as group:
        blocks_group = group[BLOCKS_GROUP].create_group(blocks_mark(fingerprint))
        blocks_group.create_array(
            "done", shape=(blocks,), chunks=(1,), dtype=bool, fill_value=False
        )
        blocks_group.create_array("steps", data=np.asarray(steps, float), compressors=checksummed())
        specification_bytes = np.frombuffer(json.dumps(specification).encode(), np.uint8)
        blocks_group.create_array("order", data=specification_bytes, compressors=checksummed())
    return ZarrStore(path)
