"""Stores of sweeps: blocks in files, which one process writes each and all read, and in memory.

During a sweep each process appends the blocks that it has computed to a file of its own in the
group `blocks`, each with a checksum. The labelled dataset then replaces the group; the store is
complete when the group is gone. A fingerprint of all that determines the results protects
against mixing sweeps: the files of blocks are in a group named by it, so that a worker that was
left behind by an earlier sweep at this path writes none of its blocks among those of another.

A sweep that overwrites another writes to a folder `.NAME.new` beside it, which takes the place of
the other when the sweep is complete. Repeated after an interrupt it continues there.
"""

from __future__ import annotations

import abc
import contextlib
import json
import math
import os
import shutil
import struct
import tempfile
import uuid
import warnings
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Int, Shaped

from jaxbeam.files.netcdf import check_codecs
from jaxbeam.runtime.output_file import naming_file, writer_lock
from jaxbeam.runtime.printer import labelled_dataset

if TYPE_CHECKING:
    import xarray
    import zarr


class BlockStore(abc.ABC):
    """Store of finished blocks, in memory or on disk."""

    @abc.abstractmethod
    def missing(self, blocks: Sequence[int]) -> list[int]:
        """Those of the numbers of blocks that are not stored."""

    @abc.abstractmethod
    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        """Store the results of a block by name; their shapes are the same for all blocks."""

    @abc.abstractmethod
    def intact(self, blocks: int) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """Numbers and results of the stored ones of so many blocks."""

    @abc.abstractmethod
    def empty(self, name: str, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        """Array for the results of all runs, in memory or in a file that is mapped to memory."""

    def collect(
        self, blocks: int, index: Int[np.ndarray, "path batch"]
    ) -> dict[str, Shaped[np.ndarray, "run ..."]]:
        """Results of so many blocks by name; `index` is the number of each run, -1 without one.

        Blocks (path, batch, ...) have as many paths each; those beyond the end of the last are left
        out. Raises ValueError if a block is not stored, or damaged.
        """
        collected: dict[str, np.ndarray] = {}
        found = set()
        for block, results in self.intact(blocks):
            for name, values in results.items():
                if name not in collected:
                    shape = (int(index.max()) + 1, *values.shape[2:])
                    collected[name] = self.empty(name, shape, values.dtype)
                own = index[block * len(values) : (block + 1) * len(values)]
                is_run = own >= 0
                collected[name][own[is_run]] = values[: len(own)][is_run]
            found.add(block)
        if len(found) < blocks:
            raise ValueError("finished blocks cannot be read")
        return collected

    @abc.abstractmethod
    def finish(self, dataset: xarray.Dataset) -> None:
        """Replace the blocks by the labelled dataset of the sweep."""


class MemoryStore(BlockStore):
    """Store in memory."""

    def __init__(self):
        self._blocks: dict[int, dict[str, np.ndarray]] = {}

    def missing(self, blocks):
        return [block for block in blocks if block not in self._blocks]

    def write(self, block, results):
        self._blocks[block] = results

    def intact(self, blocks):
        return ((block, self._blocks[block]) for block in range(blocks))

    def empty(self, name, shape, dtype):
        return np.empty(shape, dtype)

    def finish(self, dataset):
        pass


FINGERPRINT_ATTRIBUTE = "jaxbeam_sweep"
BLOCKS_GROUP = "blocks"
BLOCK_FILES = ".blocks"  # ending of the files of blocks
ROWS_FILE = ".rows"  # ending of the files in which results are collected
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


def kept_blocks(path: Path) -> str:
    """Clause on the finished blocks of a store at a path; that there are none, if so."""
    blocks = path / BLOCKS_GROUP
    some = any(next(block_places(file), None) for file in blocks.rglob(f"*{BLOCK_FILES}"))
    parts = (found.parent for found in blocks.glob("*/zarr.json"))  # of words, when complete
    some = some or any(not {"steps", BLOCKS_GROUP} & set(os.listdir(part)) for part in parts)
    return "finished blocks are kept" if some else "no block has finished"


@contextlib.contextmanager
def explaining_write_errors(path: Path):
    """Replace errors in writing; raises OSError that says whether finished blocks are kept."""
    with naming_file(path, lambda: f"; {kept_blocks(path)}: mend this, then resume"):
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


def file_array(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """New array in a file, so that it may be larger than the memory.

    Raises OSError on a full disk: written to without its space, the file would end the process.
    """
    size = math.prod(shape) * dtype.itemsize
    if not size:
        return np.empty(shape, dtype)
    with open(path, "wb") as opened:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(opened.fileno(), 0, size)
        else:
            opened.truncate(size)
    return np.memmap(path, dtype, "r+", shape=shape)


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


MAX_FILE_BYTES = 2**30  # of blocks, after which a process begins another file
# Before each block: its number, its length in bytes, and their checksum, begun at the number.
BLOCK_HEAD = struct.Struct("<IQI")


class BlockPlace(NamedTuple):
    """Place of a block in a file: its first byte and length after the head, and its checksum."""

    file: Path
    block: int
    start: int
    length: int
    checksum: int


def append_block(file: Path, block: int, results: dict[str, np.ndarray]) -> None:
    """Append the results of a block to a file: a head, a line of JSON, then the numbers."""
    arrays = [np.ascontiguousarray(values) for values in results.values()]
    kinds = [(values.dtype.str, values.shape) for values in arrays]
    parts = [json.dumps([list(results), kinds]).encode() + b"\n", *arrays]
    length, checksum = sum(memoryview(part).nbytes for part in parts), block
    for part in parts:
        checksum = zlib.crc32(part, checksum)
    with open(file, "ab") as opened:
        opened.writelines([BLOCK_HEAD.pack(block, length, checksum), *parts])


def block_places(file: Path) -> Iterator[BlockPlace]:
    """Places of the blocks of a file, without the last one if its writing was interrupted."""
    with open(file, "rb") as opened:
        size, start = os.fstat(opened.fileno()).st_size, BLOCK_HEAD.size
        while start <= size:
            opened.seek(start - BLOCK_HEAD.size)
            block, length, checksum = BLOCK_HEAD.unpack(opened.read(BLOCK_HEAD.size))
            if length > size - start:
                return
            yield BlockPlace(file, block, start, length, checksum)
            start += length + BLOCK_HEAD.size


def read_block(place: BlockPlace) -> dict[str, np.ndarray]:
    """Results of a block by name. Raises ValueError if it is not as it was written."""
    with open(place.file, "rb") as opened:
        opened.seek(place.start)
        content = opened.read(place.length)
    if zlib.crc32(content, place.block) != place.checksum:
        raise ValueError(f"a block of {place.file.name} is not as it was written")
    start = content.index(b"\n") + 1
    results, (names, kinds) = {}, json.loads(content[:start])
    for name, (dtype, shape) in zip(names, kinds, strict=True):
        values = np.frombuffer(content, dtype, math.prod(shape), start)
        results[name] = values.reshape(shape)
        start += values.nbytes
    return results


class ZarrStore(BlockStore):
    """Store of blocks in a zarr group; `steps` are those given to `create_store`.

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
            self.steps = np.asarray(self._blocks["steps"][:])
        self._folder = path / BLOCKS_GROUP / mark
        self._own_file = self._new_file()

    def specification(self) -> dict[str, Any]:
        """Specification of the sweep, as given to `create_store`."""
        with explaining_damage(self._path):
            return json.loads(np.asarray(self._blocks["order"][:]).tobytes())

    def missing(self, blocks: Sequence[int]) -> list[int]:
        written = {place.block for place in self._places(blocks)}
        intact = {block for block, _ in self._intact(blocks)}
        if damaged := written - intact:
            warnings.warn(
                f"{self._path}: {len(damaged)} finished blocks are damaged and are computed again",
                stacklevel=3,
            )
        return [block for block in blocks if block not in intact]

    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        with explaining_write_errors(self._path):
            if self._own_file.exists() and self._own_file.stat().st_size > MAX_FILE_BYTES:
                self._own_file = self._new_file()
            append_block(self._own_file, block, results)

    def intact(self, blocks: int) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        return self._intact(range(blocks))

    def empty(self, name: str, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        with explaining_write_errors(self._path):
            return file_array(self._folder / f"{name}{ROWS_FILE}", shape, dtype)

    def collect(self, blocks, index):
        """As `BlockStore.collect` does. Raises ValueError that says how to mend the store."""
        try:
            return super().collect(blocks, index)
        except ValueError as error:
            with explaining_damage(self._path):
                raise error from None

    def finish(self, dataset: xarray.Dataset) -> None:
        replace_blocks(self._path, dataset)

    def _new_file(self) -> Path:
        """Path of a file of blocks that no other process writes."""
        return self._folder / f"{uuid.uuid4().hex}{BLOCK_FILES}"

    def _places(self, blocks: Sequence[int]) -> Iterator[BlockPlace]:
        """Places of some blocks; of one that was computed again there are several."""
        for file in sorted(self._folder.glob(f"*{BLOCK_FILES}")):
            yield from (place for place in block_places(file) if place.block in blocks)

    def _intact(self, blocks: Sequence[int]) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """Numbers and results of those of some blocks that can be read."""
        for place in self._places(blocks):
            with contextlib.suppress(*DAMAGE_ERRORS):
                yield place.block, read_block(place)


def read_dataset(path: Path) -> xarray.Dataset:
    """Dataset of a complete store, whose histories are read where they are used.

    Raises ValueError if part of it is missing or damaged; damage of histories is found in reading.
    """
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
        dataset = xarray.open_zarr(path, chunks=None, consolidated=False, zarr_format=3)
        for variable in dataset.variables.values():
            if variable.dims == ("time",) or "time" not in variable.dims:
                variable.load()
        return dataset


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
    steps: np.ndarray,
) -> ZarrStore:
    """New store of a sweep, with its specification.

    `steps` are the step sizes (s) of the batches and the error estimate. Raises OSError if the
    store cannot be written.
    """
    with new_store(path, fingerprint) as group:
        blocks_group = group[BLOCKS_GROUP].create_group(blocks_mark(fingerprint))
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
