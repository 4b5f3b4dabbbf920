"""Stores of sweeps: blocks in zarr, which one process writes and all read, and in memory.

During a sweep each block is one chunk of flat arrays in the group `blocks`, written before its flag
in the array `done`. The labelled dataset then replaces the group; the store is complete when the
group is gone. A fingerprint of all that determines the results protects against mixing sweeps: the
arrays of blocks are in a group named by it, so that a worker that was left behind by an earlier
sweep at this path writes none of its blocks among those of another.

A sweep that overwrites another writes to a folder `.NAME.new` beside it, which takes the place of
the other when the sweep is complete. Repeated after an interrupt it continues there.
"""

from __future__ import annotations

import abc
import contextlib
import json
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxbeam.files.netcdf import check_codecs
from jaxbeam.runtime.dataset import labelled_dataset
from jaxbeam.runtime.output_file import naming_file, writer_lock

if TYPE_CHECKING:
    import xarray
    import zarr


class BlockStore(abc.ABC):
    """Store of finished blocks, in memory or on disk."""

    @abc.abstractmethod
    def missing(self) -> list[int]:
        """Numbers of the blocks that are not stored."""

    @abc.abstractmethod
    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        """Store the results of a block by name; their shapes are the same for all blocks."""

    @abc.abstractmethod
    def collect(self) -> dict[str, np.ndarray]:
        """Results of all blocks by name, concatenated along the first axis."""

    @abc.abstractmethod
    def finish(self, dataset: xarray.Dataset) -> None:
        """Replace the blocks by the labelled dataset of the sweep."""


class MemoryStore(BlockStore):
    """Store in memory."""

    def __init__(self, blocks: int):
        self._blocks: list[dict[str, np.ndarray]] = [{} for _ in range(blocks)]

    def missing(self):
        return [i for i, block in enumerate(self._blocks) if not block]

    def write(self, block, results):
        self._blocks[block] = results

    def collect(self):
        names = self._blocks[0]
        return {name: np.concatenate([block[name] for block in self._blocks]) for name in names}

    def finish(self, dataset):
        pass


FINGERPRINT_ATTRIBUTE = "jaxbeam_sweep"
BLOCKS_GROUP = "blocks"
DAMAGE_ERRORS = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    RuntimeError,
)  # of zarr, for damaged files


def blocks_mark(fingerprint: str) -> str:
    """Name of the group of the blocks of a sweep, within BLOCKS_GROUP."""
    return fingerprint[:16]


def checksummed() -> list[Any]:
    """Compressor of arrays, with a checksum by which damage is detected.

    Of numbers with random last digits little more is left out at higher levels, in four times as
    long: 3 % of 4096 histories.
    """
    from zarr.codecs import ZstdCodec

    return [ZstdCodec(level=1, checksum=True)]


def array_options() -> dict[str, Any]:
    """Options of arrays with which damaged and missing chunks are detected."""
    return {"compressors": checksummed(), "config": {"write_empty_chunks": True}}


def is_complete(array: zarr.Array) -> bool:
    """Whether all chunks of an array exist; zarr reads missing ones as zeros."""
    return array.nchunks_initialized == array.nchunks


@contextlib.contextmanager
def explaining_damage(path: Path):
    """Replace errors of zarr about damaged files; raises ValueError of one sentence instead."""
    try:
        yield
    except DAMAGE_ERRORS as error:
        raise ValueError(
            f"{path} is damaged ({' '.join(str(error).split())}): make the sweep anew, under"
            " another name or with overwrite"
        ) from None


@contextlib.contextmanager
def explaining_write_errors(path: Path):
    """Replace errors in writing; raises OSError that says that finished blocks are kept."""
    with naming_file(path, "; finished blocks are kept: mend this, then resume"):
        yield


@contextlib.contextmanager
def new_store(path: Path, fingerprint: str) -> Iterator[Any]:
    """Group of a new, unfinished store at a path where there is none, to be filled.

    Raises OSError if the store cannot be written.
    """
    import zarr

    # Written next to the path and renamed, so that a store is complete or does not exist.
    temporary_path = path.with_name(f".{path.name}.start")
    shutil.rmtree(temporary_path, ignore_errors=True)
    try:
        with naming_file(path):
            group = zarr.create_group(temporary_path, zarr_format=3)
            group.create_group(BLOCKS_GROUP)
            yield group
            group.attrs[FINGERPRINT_ATTRIBUTE] = fingerprint
            temporary_path.rename(path)
    finally:
        shutil.rmtree(temporary_path, ignore_errors=True)


def _of_any_length(values: np.ndarray) -> np.ndarray:
    return values.astype(np.dtypes.StringDType()) if values.dtype.kind == "U" else values


def replace_blocks(path: Path, dataset: xarray.Dataset) -> None:
    """Replace the blocks of a store by the labelled dataset of the sweep.

    Raises OSError if the store cannot be written, or is that of another sweep meanwhile.
    """
    import zarr

    with explaining_write_errors(path):
        found = zarr.open_group(path, mode="r", zarr_format=3).attrs.get(FINGERPRINT_ATTRIBUTE)
        if found != dataset.attrs[FINGERPRINT_ATTRIBUTE]:
            raise OSError("another sweep has taken its place")
        # Arrays of an interrupted attempt may be incomplete.
        for folder in path.iterdir():
            if folder.is_dir() and folder.name != BLOCKS_GROUP:
                shutil.rmtree(folder)
        # Zarr specifies strings of variable length, not of fixed length.
        variables, coordinates = (
            {name: (one.dims, _of_any_length(one.values), one.attrs) for name, one in part.items()}
            for part in (dataset.data_vars, dataset.coords)
        )
        labelled_dataset(variables, coordinates, dataset.attrs).to_zarr(
            path,
            mode="a",
            consolidated=False,
            zarr_format=3,
            write_empty_chunks=True,
            encoding={name: {"compressors": checksummed()} for name in dataset.variables},
        )
        # Without its metadata the group is gone and the store complete.
        (path / BLOCKS_GROUP / "zarr.json").unlink()
        shutil.rmtree(path / BLOCKS_GROUP, ignore_errors=True)


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
