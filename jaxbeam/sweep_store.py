"""Where the results of a long sweep are kept, block by block, so that an interruption costs little.

While a sweep runs, each block is one chunk of flat arrays in the group `blocks` of a zarr store,
written before the flag that says it is done. When all are done, the labelled dataset takes
their place. A fingerprint of everything that shapes the numbers guards against mixing sweeps.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import xarray

if TYPE_CHECKING:
    import zarr  # takes long to import; only sweeps that are kept need it

STATUS = "jaxbeam_sweep"


class Keeper(Protocol):
    """Keeps finished blocks: in memory or on disk."""

    def missing(self) -> list[int]:
        """Blocks that are not done."""
        ...

    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        """Keep the results of a block, arrays of the same length in every block."""
        ...

    def collect(self) -> dict[str, np.ndarray]:
        """Results of all blocks, one after the other."""
        ...

    def finish(self, dataset: xarray.Dataset) -> None:
        """Put the labelled dataset in the place of the blocks."""
        ...


class Memory:
    """Keeps blocks in memory."""

    def __init__(self, blocks: int):
        self._blocks: list[dict[str, np.ndarray] | None] = [None] * blocks

    def missing(self) -> list[int]:
        """Blocks that are not done."""
        return [i for i, block in enumerate(self._blocks) if block is None]

    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        """Keep the results of a block."""
        self._blocks[block] = results

    def collect(self) -> dict[str, np.ndarray]:
        """Results of all blocks, one after the other."""
        blocks = [block for block in self._blocks if block is not None]
        return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}

    def finish(self, dataset: xarray.Dataset) -> None:
        """Nothing is left to do."""


class Disk:
    """Keeps blocks in a zarr store."""

    def __init__(self, path: Path, group: zarr.Group):
        self._path = path
        self._group = group
        self._blocks = group["blocks"]
        self.steps = np.asarray(self._blocks["steps"][:])

    def missing(self) -> list[int]:
        """Blocks that are not done."""
        return np.flatnonzero(~np.asarray(self._blocks["done"][:])).tolist()

    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        """Write the results of a block, each array as one chunk, then the flag."""
        for name, values in results.items():
            if name not in self._blocks:
                count = len(self._blocks["done"][:])
                shape = (count * values.shape[0], *values.shape[1:])
                self._blocks.create_array(
                    name, shape=shape, chunks=values.shape, dtype=values.dtype
                )
            size = values.shape[0]
            self._blocks[name][block * size : (block + 1) * size] = values
        self._blocks["done"][block] = True

    def collect(self) -> dict[str, np.ndarray]:
        """Results of all blocks, one after the other."""
        names = (name for name in self._blocks.array_keys() if name not in ("done", "steps"))
        return {name: np.asarray(self._blocks[name][:]) for name in names}

    def finish(self, dataset: xarray.Dataset) -> None:
        """Write the labelled dataset, and only then drop the blocks.

        The labels of the sensors are left out, as zarr has no settled way to store words; the
        case in the attributes has them.
        """
        dataset.drop_vars("sensor").to_zarr(self._path, mode="a", consolidated=False)
        self._group.attrs[STATUS] = "complete"
        shutil.rmtree(self._path / "blocks")


def read(path: Path) -> xarray.Dataset:
    """The dataset of a complete store, without the labels of the sensors."""
    shutil.rmtree(path / "blocks", ignore_errors=True)  # left if the end was interrupted
    dataset = xarray.open_zarr(path, consolidated=False).load()
    for name in (STATUS, "fingerprint"):
        dataset.attrs.pop(name, None)
    return dataset


def status(path: Path) -> tuple[str, str] | None:
    """Status and fingerprint of the sweep stored at a path, None if there is nothing.

    Raises FileExistsError if something else is there.
    """
    import zarr

    if not path.exists():
        return None
    try:
        attributes = zarr.open_group(path, mode="r").attrs
        return str(attributes[STATUS]), str(attributes["fingerprint"])
    except (KeyError, FileNotFoundError, ValueError):
        raise FileExistsError(
            f"{path} exists and is not a sweep of jaxbeam; choose another name"
        ) from None


def prepare(path: Path, fingerprint: str, resume: bool, overwrite: bool) -> str:
    """Decide what to do about a path: "new", "resume" or "complete".

    Raises FileExistsError if a sweep is there and neither `resume` nor `overwrite` is set, and
    ValueError if it was made from other numbers than are to be resumed.
    """
    found = status(path)
    if found is None:
        return "new"
    if overwrite:
        shutil.rmtree(path)
        return "new"
    if not resume:
        raise FileExistsError(
            f"{path} holds a sweep already ({found[0]}); resume it, overwrite it, or choose "
            "another name"
        )
    if found[1] != fingerprint:
        raise ValueError(
            f"{path} holds a sweep of another case, other values or settings, or by another "
            "version: it cannot be resumed with these; choose another name, or overwrite it"
        )
    return "complete" if found[0] == "complete" else "resume"


def create(path: Path, fingerprint: str, blocks: int, steps: np.ndarray) -> Disk:
    """Start a store for a number of blocks; `steps` (s) are the time steps of the tasks."""
    import zarr

    # Built aside and moved into place: a store either exists whole or not at all.
    fresh = path.with_name(path.name + ".new")
    shutil.rmtree(fresh, ignore_errors=True)
    group = zarr.create_group(fresh)
    inner = group.create_group("blocks")
    inner.create_array("done", shape=(blocks,), chunks=(1,), dtype=bool, fill_value=False)
    inner.create_array("steps", data=np.asarray(steps, float))
    group.attrs["fingerprint"] = fingerprint
    group.attrs[STATUS] = "unfinished"
    fresh.rename(path)
    return reopen(path)


def reopen(path: Path) -> Disk:
    """Open an unfinished store."""
    import zarr

    return Disk(path, zarr.open_group(path, mode="r+"))
