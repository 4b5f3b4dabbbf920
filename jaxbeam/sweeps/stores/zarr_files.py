"""Files of a store in zarr format: options, damage, and the dataset that replaces the blocks."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxbeam.runtime.dataset import labelled_dataset
from jaxbeam.runtime.whole_file import naming_file

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX
    import zarr  # takes long to import; only stored sweeps need it

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
    """Compressor of arrays, with a checksum by which damage is detected."""
    from zarr.codecs import ZstdCodec

    return [ZstdCodec(checksum=True)]


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

    # Written beside the path and renamed, so that a store is complete or does not exist.
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
