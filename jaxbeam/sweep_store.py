"""Where the results of a long sweep are kept, block by block, so that an interruption costs little.

While a sweep runs, each block is one chunk of flat arrays in the group `blocks` of a zarr store,
written before the flag that says it is done. When all are done, the labelled dataset takes
their place; the store is complete from the moment at which the group is gone. A fingerprint of
everything that shapes the numbers guards against mixing sweeps.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import xarray

if TYPE_CHECKING:
    import zarr  # takes long to import; only sweeps that are kept need it

FINGERPRINT = "jaxbeam_sweep"
BLOCKS = "blocks"


class Keeper(Protocol):
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


class Memory(Keeper):
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


class Disk(Keeper):
    """Keeps blocks in a zarr store; `steps` is what `create` was given with them."""

    def __init__(self, path: Path, group: zarr.Group):
        self._path = path
        self._blocks: Any = group[BLOCKS]
        self.steps = np.asarray(self._blocks["steps"][:])

    def missing(self) -> list[int]:
        return np.flatnonzero(~np.asarray(self._blocks["done"][:])).tolist()

    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        count = self._blocks["done"].shape[0]
        for name, values in results.items():
            size = values.shape[0]
            if name not in self._blocks:
                self._blocks.create_array(
                    name,
                    shape=(count * size, *values.shape[1:]),
                    chunks=values.shape,
                    dtype=values.dtype,
                )
            self._blocks[name][block * size : (block + 1) * size] = values
        self._blocks["done"][block] = True

    def collect(self) -> dict[str, np.ndarray]:
        names = set(self._blocks.array_keys()) - {"done", "steps"}
        return {name: np.asarray(self._blocks[name][:]) for name in sorted(names)}

    def finish(self, dataset: xarray.Dataset) -> None:
        # What an interrupted attempt has left may be incomplete.
        for part in self._path.iterdir():
            if part.is_dir() and part.name != BLOCKS:
                shutil.rmtree(part)
        # Words of fixed length have no settled place in the format, words of any length do.
        words = dataset["sensor"].values.astype(object)
        dataset.assign_coords(sensor=words).to_zarr(self._path, mode="a", consolidated=False)
        # From here on the store is complete: a group is one by its description.
        (self._path / BLOCKS / "zarr.json").unlink()
        shutil.rmtree(self._path / BLOCKS)


def read(path: Path) -> xarray.Dataset:
    """The dataset of a complete store."""
    shutil.rmtree(path / BLOCKS, ignore_errors=True)  # a kill may have left its chunks behind
    return xarray.open_zarr(path, consolidated=False).load()


def status(path: Path) -> tuple[str, str] | None:
    """Status ("unfinished", "complete") and fingerprint of the sweep at a path, None without one.

    Raises FileExistsError if something else is there.
    """
    import zarr

    if not path.exists():
        return None
    try:
        fingerprint = str(zarr.open_group(path, mode="r").attrs[FINGERPRINT])
    except (KeyError, OSError, ValueError):
        raise FileExistsError(
            f"{path} exists and is not a sweep of jaxbeam; choose another name"
        ) from None
    unfinished = (path / BLOCKS / "zarr.json").exists()
    return "unfinished" if unfinished else "complete", fingerprint


def prepare(path: Path, fingerprint: str, resume: bool, overwrite: bool) -> str:
    """Decide what to do about a path: "new", "resume" or "complete"; nothing is changed there.

    Raises FileExistsError if a sweep is there and neither `resume` nor `overwrite` is set, and
    ValueError if both are, or if it was made from other numbers than are to be resumed.
    """
    if resume and overwrite:
        raise ValueError("resume continues a sweep, overwrite discards it; choose one of them")
    found = status(path)
    if found is None or overwrite:
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


def create(
    path: Path, fingerprint: str, blocks: int, steps: np.ndarray, overwrite: bool = False
) -> Disk:
    """Start a store for a number of blocks; `steps` (s) are the time steps of the tasks.

    With `overwrite` what is at the path gives way.
    """
    import zarr

    # Built aside and moved into place: a store either exists whole or not at all.
    fresh = path.with_name(f".{path.name}.new")
    shutil.rmtree(fresh, ignore_errors=True)
    group = zarr.create_group(fresh)
    inner = group.create_group(BLOCKS)
    inner.create_array("done", shape=(blocks,), chunks=(1,), dtype=bool, fill_value=False)
    inner.create_array("steps", data=np.asarray(steps, float))
    group.attrs[FINGERPRINT] = fingerprint
    if overwrite:
        shutil.rmtree(path, ignore_errors=True)
    fresh.rename(path)
    return reopen(path)


def reopen(path: Path) -> Disk:
    """Open an unfinished store."""
    import zarr

    return Disk(path, zarr.open_group(path, mode="r+"))
