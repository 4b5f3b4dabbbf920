"""Universal files (.uff, .unv): functions of type 58, by pyuff.

The format is described by the Structural Dynamics Research Laboratory, University of Cincinnati,
"Universal Dataset Number 58, Function at Nodal DOF".
"""

import contextlib
import io
import re
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxbeam.runtime.packages import import_extra
from tuning.logs.readers.table import (
    Clock,
    LogFormat,
    LogTable,
    damaged_file_error,
    join_channels,
    read_bytes,
)

MAGIC = b"    -1\n"
MAGICS = (MAGIC, MAGIC.replace(b"\n", b"\r\n"), MAGIC.replace(b"\n", b" "))
TIME_RESPONSE = 1
_MARK = re.compile(rb"    -1(?=[\r\n]|$| {74})")  # before and after a data set
_FORTRAN = re.compile(rb"(\d\.\d*)D([-+]\d)")
_TYPES = ([b"58"], [b"58b"])
# Code of the quantity of the ordinate: unit in a file of SI units.
UNITS = {2: "N/m^2", 3: "strain", 8: "m", 9: "N", 11: "m/s", 12: "m/s^2", 13: "N"}
AXES = {1: "x", 2: "y", 3: "z", 4: "rx", 5: "ry", 6: "rz"}


def read_uff(path: Path) -> dict[str, LogTable]:
    """Table of the time responses in a universal file, named by node and direction, as `12z`.

    Responses of other times are joined over the time in common, or runs of their own if they are of
    the same nodes again. Units are the label of the axis, or else that of the SI for the quantity.
    A warning names the function within which the file breaks off.

    Raises ValueError for a damaged file and one without time responses, ImportError without pyuff.
    """
    cut = _cut_off(path)
    pyuff = import_extra("pyuff", "uff")
    try:
        # pyuff prints what it does not know.
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with _with_exponents_e(path) as readable:
                file = pyuff.UFF(str(readable))
                kinds = file.get_set_types()
                sets = [file.read_sets(i) for i in np.flatnonzero(np.asarray(kinds) == 58)]
    except Exception as error:  # pyuff raises many types for damaged files
        raise damaged_file_error(path, error) from None
    responses = [one for one in sets if int(one.get("func_type", 0)) == TIME_RESPONSE]
    if not responses:
        what = f"{len(sets)} functions, none of which is" if sets else "no functions of type 58,"
        said = "".join(f"; {one}" for one in cut)
        raise ValueError(f"{path}: the universal file has {what} a response over time{said}")
    for one in responses:
        if int(one.get("num_pts", len(one["data"]))) != len(one["data"]):
            raise ValueError(
                f"{path}: the file is damaged: {_name(one)} has {len(one['data'])} of"
                f" {int(one['num_pts'])} samples"
            )
    grids: dict[tuple, list] = {}
    for one in responses:
        times = np.asarray(one["x"], float).real
        grids.setdefault((times.size, times[0], times[-1]), []).append(one)
    tables = [_table(group, cut) for group in grids.values()]
    if len(tables) == 1:
        return {"": tables[0]}
    names = [name for table in tables for name in table.names[1:]]
    even = all(np.ptp(np.diff(table.values[:, 0])) < 1e-3 / len(table.values) for table in tables)
    if len(set(names)) == len(names) and even:
        return {"": _joined(str(path), tables, cut)}
    return {f"{i + 1}": table for i, table in enumerate(tables)}


@contextlib.contextmanager
def _with_exponents_e(path: Path) -> Iterator[Path]:
    """The file, or a copy in which exponents of Fortran, as 1.5D+00, are written with E."""
    data = read_bytes(path)
    if b"   58b" in data or not _FORTRAN.search(data):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        with open(copy, "wb") as file:
            file.write(_FORTRAN.sub(rb"\1E\2", data))
        yield copy


def _joined(source: str, tables: list[LogTable], cut) -> LogTable:
    """Channels of several grids of times as one run."""
    arrays, clocks, units = {}, {}, []
    for table in tables:
        times = table.values[:, 0]
        clock = Clock(times[0], (times[-1] - times[0]) / (times.size - 1))
        arrays |= dict(zip(table.names[1:], table.values[:, 1:].T, strict=True))
        clocks |= dict.fromkeys(table.names[1:], clock)
        units += table.units[1:]
    times, joined, said = join_channels(source, arrays, clocks)
    values = np.column_stack([times, *(joined[name] for name in arrays)])
    names = ("time", *arrays)
    return LogTable(names, ("s", *units), values, time="time", warnings=(*cut, *said))


def _cut_off(path: Path) -> tuple[str, ...]:
    """Warning about the data set within which a file breaks off: none if it has its end."""
    data = read_bytes(path)
    marks = [found.start() for found in _MARK.finditer(data)]
    if len(marks) % 2 == 0:
        return ()
    lines = data[marks[-1] :].split(b"\n", 8)
    line = data.count(b"\n", 0, marks[-1]) + 1
    place = f"the file breaks off within data set {len(marks) // 2 + 1}, line {line}"
    if len(lines) > 8 and lines[1].split()[:1] in _TYPES:
        node, direction = lines[7][41:51].strip(), lines[7][51:55].strip()  # fixed columns
        if node.isdigit() and direction.lstrip(b"-").isdigit():
            name = f"{int(node)}{_direction(int(direction))}"
            return (f"{place}, of the channel {name}, which is left out",)
    return (f"{place}, which is left out",)


def _name(one) -> str:
    return f"{int(one.get('rsp_node', 0))}{_direction(int(one.get('rsp_dir', 0)))}"


def _table(functions, cut: tuple[str, ...]) -> LogTable:
    """Table of functions with common times."""
    names, units, columns = ["time"], ["s"], [np.asarray(functions[0]["x"], float).real]
    for one in functions:
        name = _name(one)
        same = sum(label.split(" ")[0] == name for label in names)
        names.append(f"{name} ({same + 1})" if same else name)
        label = str(one.get("ordinate_axis_units_lab", "")).strip()
        code = int(one.get("ordinate_spec_data_type", 0))
        units.append(label if label and label.upper() != "NONE" else UNITS.get(code))
        columns.append(np.asarray(one["data"]).real.astype(float))
    values = np.column_stack(columns)
    return LogTable(tuple(names), tuple(units), values, time="time", warnings=cut)


def _direction(code: int) -> str:
    axis = AXES.get(abs(code), "")
    return f"-{axis}" if code < 0 else axis


FORMAT = LogFormat("universal", read_uff, suffixes=(".uff", ".unv"), magics=MAGICS)
