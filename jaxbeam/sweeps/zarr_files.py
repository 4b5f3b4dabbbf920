"""Files of a store in zarr format: options, damage, and the dataset that replaces the blocks."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX
    import zarr  # takes long to import; only stored sweeps need it

FINGERPRINT_ATTRIBUTE = "jaxbeam_sweep"
BLOCKS_GROUP = "blocks"
CODECS = ("bytes", "vlen-utf8", "zstd")
DATA_TYPES = ("bool", "uint8", "int32", "int64", "float32", "float64", "string")
OTHER_FORMATS = (".zarray", ".zgroup", ".zattrs", ".zmetadata")  # files of zarr of format 2
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


def check_codecs(path: Path) -> None:
    """Check, before anything is decoded, that a store has no codecs but those of jaxbeam.

    Others, of format 2 above all, may run code of the store. Raises ValueError for one, and for
    metadata that cannot be read.
    """
    for folder, folders, files in os.walk(path):
        # A link could lead to metadata that is changed after this check.
        links = [name for name in (*folders, *files) if os.path.islink(os.path.join(folder, name))]
        foreign = [*links, *(name for name in files if name in OTHER_FORMATS)]
        if foreign:
            raise ValueError(f"jaxbeam writes no {foreign[0]}, which is in {folder}")
        if "zarr.json" in files:
            _check_metadata(Path(folder, "zarr.json"))


def _check_metadata(file: Path) -> None:
    """Raise ValueError for metadata of an array or group that jaxbeam does not write."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        raise ValueError(f"{file} is not readable") from None
    if not isinstance(content, dict) or content.get("consolidated_metadata") is not None:
        raise ValueError(f"{file} is not as jaxbeam writes it")
    if content.get("node_type") == "group":
        return
    codecs = content.get("codecs")
    names = [codec.get("name") if isinstance(codec, dict) else codec for codec in codecs or ()]
    unknown = [name for name in names if name not in CODECS]
    if content.get("data_type") not in DATA_TYPES or unknown or content.get("storage_transformers"):
        used = unknown[0] if unknown else content.get("data_type")
        raise ValueError(f"{file} uses {str(used)[:80]!r}, which jaxbeam does not write")


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
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise type(error)(
            f"cannot write to {path}: {reason}; finished blocks are kept: mend this, then resume"
        ) from None


@contextlib.contextmanager
def new_store(path: Path, fingerprint: str) -> Iterator[Any]:
    """Group of a new, unfinished store at a path where there is none, to be filled.

    Raises OSError if the store cannot be written.
    """
    import zarr

    # Written beside the path and renamed, so that a store is complete or does not exist.
    temporary_path = path.with_name(f".{path.name}.start")
    shutil.rmtree(temporary_path, ignore_errors=True)
    with explaining_write_errors(path):
        group = zarr.create_group(temporary_path, zarr_format=3)
        group.create_group(BLOCKS_GROUP)
        yield group
        group.attrs[FINGERPRINT_ATTRIBUTE] = fingerprint
        temporary_path.rename(path)


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
        labels = {
            name: (values.dims, values.values.astype(object), values.attrs)
            for name, values in dataset.coords.items()
            if values.dtype.kind == "U"
        }
        dataset.assign_coords(labels).to_zarr(
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
