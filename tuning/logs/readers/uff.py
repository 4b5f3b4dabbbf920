"""Universal files (.uff, .unv): functions of type 58, by pyuff.

The format is described by the Structural Dynamics Research Laboratory, University of Cincinnati,
"Universal Dataset Number 58, Function at Nodal DOF".
"""

import contextlib
import io
import warnings
from pathlib import Path

import numpy as np

from tuning.logs.readers.table import LogFormat, LogTable, damaged_file_error
from tuning.optional import import_extra

MAGIC = b"    -1\n"
MAGICS = (MAGIC, MAGIC.replace(b"\n", b"\r\n"), MAGIC.replace(b"\n", b" "))
TIME_RESPONSE = 1
# Code of the quantity of the ordinate: unit in a file of SI units.
UNITS = {2: "N/m^2", 3: "strain", 8: "m", 9: "N", 11: "m/s", 12: "m/s^2", 13: "N"}
AXES = {1: "x", 2: "y", 3: "z", 4: "rx", 5: "ry", 6: "rz"}


def read_uff(path: Path) -> dict[str, LogTable]:
    """Table of the time responses in a universal file, named by node and direction, as `12z`.

    Functions of another length or sampling step are runs of their own. Units are the label of the
    axis, or else that of the SI for the quantity.

    Raises ValueError for a damaged file and one without time responses, ImportError without pyuff.
    """
    pyuff = import_extra("pyuff", "uff")
    try:
        # pyuff prints what it does not know.
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            file = pyuff.UFF(str(path))
            kinds = file.get_set_types()
            sets = [file.read_sets(i) for i in np.flatnonzero(np.asarray(kinds) == 58)]
    except Exception as error:  # pyuff raises many types for damaged files
        raise damaged_file_error(path, error) from None
    responses = [one for one in sets if int(one.get("func_type", 0)) == TIME_RESPONSE]
    if not responses:
        what = f"{len(sets)} functions, none of which is" if sets else "no functions of type 58,"
        raise ValueError(f"{path}: the universal file has {what} a response over time")
    grids: dict[tuple, list] = {}
    for one in responses:
        times = np.asarray(one["x"], float).real
        grids.setdefault((times.size, times[0], times[-1]), []).append(one)
    tables = [_table(group) for group in grids.values()]
    if len(tables) == 1:
        return {"": tables[0]}
    return {f"{i + 1}": table for i, table in enumerate(tables)}


def _table(functions) -> LogTable:
    """Table of functions with common times."""
    names, units, columns = ["time"], ["s"], [np.asarray(functions[0]["x"], float).real]
    for one in functions:
        name = f"{int(one.get('rsp_node', 0))}{_direction(int(one.get('rsp_dir', 0)))}"
        same = sum(label.split(" ")[0] == name for label in names)
        names.append(f"{name} ({same + 1})" if same else name)
        label = str(one.get("ordinate_axis_units_lab", "")).strip()
        code = int(one.get("ordinate_spec_data_type", 0))
        units.append(label if label and label.upper() != "NONE" else UNITS.get(code))
        columns.append(np.asarray(one["data"]).real.astype(float))
    return LogTable(tuple(names), tuple(units), np.column_stack(columns), time="time")


def _direction(code: int) -> str:
    axis = AXES.get(abs(code), "")
    return f"-{axis}" if code < 0 else axis


FORMAT = LogFormat("universal file", read_uff, suffixes=(".uff", ".unv"), magics=MAGICS)
