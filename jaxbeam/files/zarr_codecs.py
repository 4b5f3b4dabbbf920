"""What of a zarr store is decoded: the codecs that jaxbeam writes, and no others."""

import json
import os
from pathlib import Path

from jaxbeam.runtime.input_file import check_input

CODECS = ("bytes", "vlen-utf8", "zstd")
DATA_TYPES = ("bool", "uint8", "int32", "int64", "float32", "float64", "string")
OTHER_FORMATS = (".zarray", ".zgroup", ".zattrs", ".zmetadata")  # files of zarr of format 2


def check_codecs(path: Path) -> None:
    """Check, before anything is decoded, that a store has no codecs but those of jaxbeam.

    Others, of format 2 above all, may run code of the store. Raises ValueError for one, and for
    metadata that cannot be read; OSError for a part that is no regular file.
    """
    for folder, folders, files in os.walk(path):
        # A link could lead to metadata that is changed after this check.
        links = [name for name in (*folders, *files) if os.path.islink(os.path.join(folder, name))]
        foreign = [*links, *(name for name in files if name in OTHER_FORMATS)]
        if foreign:
            raise ValueError(f"jaxbeam writes no {foreign[0]}, which is in {folder}")
        for name in files:
            check_input(Path(folder, name), "part of a store")
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
