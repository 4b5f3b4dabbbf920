"""Writer of labelled variables to netCDF files, as xarray writes them, without importing xarray."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

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
