"""NetCDF files and zarr stores of datasets, with the codecs of their arrays."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxbeam.runtime.input_file import check_input

CODECS = ("bytes", "vlen-utf8", "zstd")
DATA_TYPES = ("bool", "int8", "uint8", "int32", "int64", "float32", "float64", "string")
OTHER_FORMATS = (".zarray", ".zgroup", ".zattrs", ".zmetadata")  # files of zarr of format 2


def check_codecs(path: Path) -> None:
    """Check, before anything is decoded, that a store has only codecs that jaxbeam writes.

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


# By name: dimensions (a text for one), values, and maybe attributes, as `xarray.Dataset` has them.
Variables = Mapping[str, tuple]


def write_netcdf(
    path: str | os.PathLike,
    variables: Variables,
    coordinates: Variables,
    attributes: Mapping[str, Any],
) -> None:
    """Write a file from which `xarray.open_dataset` reads a dataset of these parts.

    Importing xarray, and with it pandas and dask, takes longer than most runs. Variables without
    entries are left out: an empty dimension would become an unlimited one in the file.
    """
    from scipy.io import netcdf_file

    # Coordinates that are not named after their dimension are listed at variables of that one.
    listed = {name: dims for name, (dims, *_) in coordinates.items() if name != dims}
    with netcdf_file(os.fspath(path), "w", version=2) as file:
        _set_attributes(file, attributes)
        for name, (dims, values, *given) in {**variables, **coordinates}.items():
            values, own = np.asarray(values), dict(*given)
            if values.size == 0:
                continue
            dims = (dims,) if isinstance(dims, str) else tuple(dims)
            labels = [] if name in coordinates else [c for c, dim in listed.items() if dim in dims]
            if labels:
                own["coordinates"] = " ".join(labels)
            if values.dtype.kind == "U":
                values, own["_Encoding"] = _characters(values), "utf-8"
                dims = (*dims, f"string{values.shape[-1]}")
            elif values.dtype.kind == "f":
                own["_FillValue"] = np.nan
            for dim, size in zip(dims, values.shape, strict=True):
                if dim not in file.dimensions:
                    file.createDimension(dim, size)
            stored = file.createVariable(name, values.dtype, dims)
            stored[...] = values
            _set_attributes(stored, own)


def _characters(texts: np.ndarray) -> np.ndarray:
    """Bytes of texts in UTF-8 along a further axis, as netCDF 3 stores texts."""
    encoded = np.char.encode(texts, "utf-8")
    return encoded.view("S1").reshape(*encoded.shape, encoded.dtype.itemsize)


def _set_attributes(owner, attributes: Mapping[str, Any]) -> None:
    """Set attributes of a file of scipy or one of its variables: texts in UTF-8, float64, int32."""
    for name, value in attributes.items():
        if isinstance(value, str):
            value = value.encode("utf-8")
        setattr(owner, name, np.float64(value) if isinstance(value, float) else value)
