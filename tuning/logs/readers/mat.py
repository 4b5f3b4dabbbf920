"""MATLAB files up to version 7; since 7.3 they are HDF5.

Consistency of the elements of a MATLAB file, checked before scipy reads it.

scipy trusts the types, sizes and counts in a file; a wrong one ends the process or takes minutes.
The format is that of "MAT-File Format" (MathWorks), section 1: a tree of data elements, each a tag
(type and size) and its data.
"""

import math
import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.io import loadmat, matlab

from jaxbeam.runtime.input_file import max_bytes
from tuning.logs.readers.table import (
    LogFormat,
    LogTable,
    clocks_by_numbers,
    damaged_file_error,
    read_bytes,
    table_of,
)

HEADER = 128  # bytes
MATRIX, COMPRESSED = 14, 15  # types of elements
# Bytes of one number, by the type of the element.
NUMBER_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
CELL, STRUCT, OBJECT, TEXT, SPARSE = 1, 2, 3, 4, 5  # classes of arrays, others are numeric
NUMERIC = range(6, 16)
FUNCTION, OPAQUE = 16, 17
COMPLEX = 1 << 11


class Element(NamedTuple):
    """A data element: the type in its tag, and its data."""

    kind: int
    data: bytes


def check_elements(content: bytes) -> None:
    """Check the elements of a MATLAB file (version 5 to 7).

    Raises ValueError for types, sizes or counts that contradict each other, zlib.error for damaged
    compressed data.
    """
    order = "<" if content[126:128] == b"IM" else ">"
    for element in _elements(content[HEADER:], order):
        if element.kind == COMPRESSED:
            (element,) = _elements(_unpacked(element.data), order)
        if element.kind == MATRIX:
            _check_array(element.data, order)


def _unpacked(data: bytes) -> bytes:
    """Data without its compression, as far as they fit into memory."""
    limit, unpacking = max_bytes("log"), zlib.decompressobj()
    content = unpacking.decompress(data, limit)
    if unpacking.unconsumed_tail:
        raise ValueError(f"an element unpacks to more than {limit / 2**30:.3g} GB")
    if not unpacking.eof:
        raise ValueError("a compressed element is cut off")
    return content


def _elements(data: bytes, order: str) -> list[Element]:
    found, offset = [], 0
    while offset + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, offset)
        start = offset + 8
        if kind >> 16:  # up to four bytes of data, within the tag
            kind, size, start = kind & 0xFFFF, kind >> 16, offset + 4
        if start + size > len(data) or kind not in (MATRIX, COMPRESSED, *NUMBER_SIZES):
            raise ValueError(f"no element can be of type {kind} and {size} bytes long")
        found.append(Element(kind, data[start : start + size]))
        # Elements begin at multiples of eight bytes, except after those that are compressed.
        offset = start + size + (0 if kind == COMPRESSED else -(start + size) % 8)
    if 0 < len(data) - offset < 8 and any(data[offset:]):
        raise ValueError(f"{len(data) - offset} bytes at the end are no element")
    return found


def _check_array(data: bytes, order: str) -> None:
    if not data:
        return  # an empty array
    flags, *rest = _elements(data, order)
    word = struct.unpack_from(f"{order}I", flags.data)[0]
    kind = word & 0xFF
    if kind in (FUNCTION, OPAQUE):
        return
    shape, name, *rest = rest
    if shape.kind not in (5, 6) or name.kind not in (1, 16):
        raise ValueError("an array has neither a shape nor a name")
    sizes = [int(size) for size in np.frombuffer(shape.data, f"{order}i4")]
    count = math.prod(sizes)
    if len(sizes) < 2 or min(sizes) < 0:
        raise ValueError(f"no array can have the shape {sizes}")
    if kind in (STRUCT, OBJECT):
        if kind == OBJECT:
            rest = rest[1:]
        length, names, *rest = rest
        width = struct.unpack_from(f"{order}i", length.data)[0]
        count *= len(names.data) // width
    if kind in (CELL, STRUCT, OBJECT):
        if len(rest) != count or any(element.kind != MATRIX for element in rest):
            raise ValueError(f"{len(rest)} arrays are where {count} should be")
        for element in rest:
            _check_array(element.data, order)
        return
    parts = 2 if word & COMPLEX else 1
    parts += 2 if kind == SPARSE else 0
    if kind not in (TEXT, SPARSE, *NUMERIC) or len(rest) != parts:
        raise ValueError(f"no array of class {kind} has {len(rest)} parts")
    for element in rest:
        if element.kind not in NUMBER_SIZES:
            raise ValueError(f"there are no numbers in an element of type {element.kind}")
        fits = len(element.data) == count * NUMBER_SIZES[element.kind]
        if kind in NUMERIC and not fits:
            raise ValueError(f"{len(element.data)} bytes are no array of shape {sizes}")


MAGIC = b"MATLAB 5.0 MAT-file"


def read_mat(path: Path) -> dict[str, LogTable]:
    """Tables of a MATLAB file: a run of its variables, and one for each struct of vectors.

    A struct `units` within a run has the units of its variables. Without a variable of times, one
    number `fs` (Hz) or `dt` (s) among them says how they are sampled. The entries of an array of
    structs are runs `name.0`, `name.1`, ... Other scalars and text are left out.

    Raises ValueError for a damaged file, or one that holds objects only (such as a timetable).
    """
    try:
        check_elements(read_bytes(path))
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except Exception as error:  # scipy raises many types for damaged files
        raise damaged_file_error(path, error) from None
    content = {name: value for name, value in content.items() if not name.startswith("__")}
    runs = {"": content}
    for name, value in content.items():
        if isinstance(value, matlab.mat_struct) and name != "units":
            runs[name] = _fields(value)
        elif isinstance(value, np.ndarray) and value.dtype == object:
            structs = [entry for entry in value.flat if isinstance(entry, matlab.mat_struct)]
            runs |= {f"{name}.{i}": _fields(entry) for i, entry in enumerate(structs)}
    tables = {}
    for name, fields in runs.items():
        arrays = {a: v for a, v in fields.items() if _is_numeric_array(v)}
        if arrays:
            units = _fields(fields["units"]) if "units" in fields else {}
            source = f"{path}, {name}" if name else str(path)
            numbers = _scalars(content) | _scalars(fields)
            clocks = clocks_by_numbers(source, dict.fromkeys(arrays, numbers), list(arrays))
            tables[name] = table_of(source, arrays, units, clocks)
    if not tables:
        raise ValueError(
            f"{path}: there is no list of numbers in it; tables and timetables are objects that "
            "only MATLAB reads: save their columns as vectors, or write them as CSV"
        )
    return tables


def _fields(struct) -> dict:
    named = isinstance(struct, matlab.mat_struct)
    return {name: getattr(struct, name) for name in struct._fieldnames} if named else {}


def _scalars(fields) -> dict[str, float]:
    """Single numbers by name in small letters, as `fs`."""
    numbers = {name.lower(): value for name, value in fields.items() if np.size(value) == 1}
    return {
        name: float(value)
        for name, value in numbers.items()
        if isinstance(value, int | float | np.number)
    }


def _is_numeric_array(value) -> bool:
    return isinstance(value, np.ndarray) and value.size > 1 and value.dtype.kind in "fiub"


FORMAT = LogFormat("MATLAB", read_mat, suffixes=(".mat",), magics=(MAGIC,))
