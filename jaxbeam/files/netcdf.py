"""Writer of labelled variables to netCDF files, as xarray writes them, without importing xarray.

The format is the classic one with offsets of 64 bits: NetCDF Classic and 64-bit Offset Format (OGC
11-038), in big-endian numbers. To import the writer of scipy takes a tenth of the time of a
command.
"""

import os
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

# By name: dimensions (a text for one), values, and maybe attributes, as `xarray.Dataset` has them.
Variables = Mapping[str, tuple]
MAGIC, DIMENSIONS, VARIABLES, ATTRIBUTES = b"CDF\x02", 10, 11, 12
# Numbers of the types in the format, by kind and size of those of NumPy.
TYPES = {"S1": 2, "i4": 4, "f4": 5, "f8": 6}


def write_netcdf(
    path: str | os.PathLike,
    variables: Variables,
    coordinates: Variables,
    attributes: Mapping[str, Any],
) -> None:
    """Write a file from which `xarray.open_dataset` reads a dataset of these parts.

    Importing xarray, and with it pandas and dask, takes longer than most runs. Variables without
    entries are left out: an empty dimension would become an unlimited one in the file. Raises
    ValueError for types of numbers that the format does not have.
    """
    # Coordinates that are not named after their dimension are listed at variables of that one.
    listed = {name: dims for name, (dims, *_) in coordinates.items() if name != dims}
    sizes: dict[str, int] = {}
    written: list[tuple[bytes, np.ndarray]] = []
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
            if sizes.setdefault(dim, size) != size:
                raise ValueError(f"dimension {dim} of {name} has {size} entries, not {sizes[dim]}")
        numbers = [list(sizes).index(dim) for dim in dims]
        head = _text(name) + struct.pack(f">{len(dims) + 1}i", len(dims), *numbers)
        written.append((head + _attributes(own) + _type(values, name), values))
    named = [_text(name) + struct.pack(">i", size) for name, size in sizes.items()]
    # An absent number of records, then the lists; each variable ends with its place in the file.
    start = MAGIC + bytes(4) + _list(DIMENSIONS, named) + _attributes(attributes)
    place = len(start) + 8 + sum(len(head) + 12 for head, _ in written)
    heads = []
    for head, values in written:
        length = values.nbytes + -values.nbytes % 4
        # Of larger variables the length is not read, but computed.
        heads.append(head + struct.pack(">Iq", min(length, 2**32 - 4), place))
        place += length
    with open(path, "wb") as file:
        file.write(start + _list(VARIABLES, heads))
        for _, values in written:
            file.write(_padded(_big_endian(values).tobytes()))


def _list(tag: int, parts: list[bytes]) -> bytes:
    """A list of the header; one without entries has no tag."""
    return struct.pack(">2i", tag if parts else 0, len(parts)) + b"".join(parts)


def _attributes(attributes: Mapping[str, Any]) -> bytes:
    """List of attributes: texts in UTF-8, float64, int32."""
    parts = []
    for name, value in attributes.items():
        if isinstance(value, str):
            value = np.frombuffer(value.encode("utf-8"), "S1")
        value = np.atleast_1d(value)
        if value.dtype.kind in "biu":
            value = value.astype("i4")
        size = struct.pack(">i", value.size)
        content = _padded(_big_endian(value).tobytes())
        parts.append(_text(name) + _type(value, name) + size + content)
    return _list(ATTRIBUTES, parts)


def _type(values: np.ndarray, name: str) -> bytes:
    """Number of the type of an array."""
    number = TYPES.get(values.dtype.str[1:])
    if number is None:
        raise ValueError(f"netCDF files of version 3 have no numbers as {name}: {values.dtype}")
    return struct.pack(">i", number)


def _big_endian(values: np.ndarray) -> np.ndarray:
    return values.astype(values.dtype.newbyteorder(">"))


def _text(text: str) -> bytes:
    """A name: its length and its bytes."""
    encoded = text.encode("utf-8")
    return struct.pack(">i", len(encoded)) + _padded(encoded)


def _padded(content: bytes) -> bytes:
    """Bytes filled to a multiple of four."""
    return content + bytes(-len(content) % 4)


def _characters(texts: np.ndarray) -> np.ndarray:
    """Bytes of texts in UTF-8 along a further axis, as netCDF 3 stores texts."""
    encoded = np.char.encode(texts, "utf-8")
    return encoded.view("S1").reshape(*encoded.shape, encoded.dtype.itemsize)
