"""State-space matrices as files for other programs, by their ending: .mat, .npz, .json, .csv."""

import csv
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from jaxbeam.files.tables import as_text_cell
from jaxbeam.model.linear_system import StateSpace
from jaxbeam.runtime.output_file import whole_file

MATRIX_SUFFIXES = (".mat", ".npz", ".json", ".csv")


def matrices_of(system: StateSpace) -> dict[str, Any]:
    """A, B, C and D as nested lists, names and units of all signals, and the period (s; 0 if none).

    Numbers are in SI units, by the names that `write_state_space` gives them.
    """
    content: dict[str, Any] = {name: np.asarray(getattr(system, name)).tolist() for name in "ABCD"}
    for kind in ("states", "inputs", "outputs"):
        signals = getattr(system, kind)
        content[kind] = [signal.name for signal in signals]
        content[f"{kind}_units"] = [signal.unit for signal in signals]
    return content | {"period": 0.0 if system.period is None else float(system.period)}


def write_state_space(system: StateSpace, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a linear system to a file: its matrices, and names and units of its signals.

    The ending decides: .mat (MATLAB, version 5), .npz (NumPy), .json, .csv: one table, a row for
    the rate of each state and for each output, a column for each state and each input. Raises
    ValueError for another ending, FileExistsError if the file exists, without `overwrite`.
    """
    path = Path(path)
    if path.suffix not in MATRIX_SUFFIXES:
        raise ValueError(f"{path}: matrices are written to a file of {', '.join(MATRIX_SUFFIXES)}")
    if path.suffix == ".mat":
        system.to_mat(path, overwrite)
        return
    content = matrices_of(system)
    with whole_file(path, overwrite) as partial:
        if path.suffix == ".npz":
            np.savez(partial, **{name: np.asarray(part) for name, part in content.items()})
        elif path.suffix == ".json":
            partial.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        else:
            _write_csv(system, partial)


def _write_csv(system: StateSpace, path: Path) -> None:
    def names(signals, words=""):
        return [f"{words}{signal.name} ({signal.unit})" for signal in signals]

    step = "rate of " if system.period is None else "next "
    heads = ["", *names(system.states), *names(system.inputs)]
    rows = np.block(
        [
            [np.asarray(part) for part in pair]
            for pair in ((system.A, system.B), (system.C, system.D))
        ]
    )
    labels = [*(f"{step}{signal.name}" for signal in system.states), *names(system.outputs)]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(map(as_text_cell, heads))
        named = zip(map(as_text_cell, labels), rows.tolist(), strict=True)
        writer.writerows([label, *row] for label, row in named)
