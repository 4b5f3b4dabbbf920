"""Results of runs, sweeps and commands as named arrays."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import jaxbeam as jb

REPOSITORY = Path(jb.__file__).resolve().parents[1]
WALL_TIMES = ("step_times", "computing_time")  # keys of JSON left out, as they never repeat

Arrays = dict[str, np.ndarray]


def of_record(record: jb.Record) -> Arrays:
    """Histories, peaks and modes of a run, its error estimate and number of steps."""
    dataset = record.to_xarray()
    arrays = {str(name): np.asarray(values) for name, values in dataset.variables.items()}
    arrays = {name: values for name, values in arrays.items() if values.dtype.kind in "fiub"}
    names = ["slope"] if record.case.controller is None else ["slope", "effort", "saturated"]
    arrays |= {name: np.asarray(getattr(record, name)) for name in names}
    # Relative to the peak: the estimate itself is a difference of peaks, with few digits.
    arrays["one_plus_error_estimate"] = np.asarray(1 + float(record.error_estimate))
    arrays["steps"] = np.asarray(record.steps)
    return arrays


def of_sweep(case: jb.Case, over: Mapping[str, Any], **options: Any) -> Arrays:
    """Results of a sweep."""
    dataset = jb.sweep(case, dict(over), progress=False, **options)
    arrays = {str(name): np.asarray(values) for name, values in dataset.variables.items()}
    arrays = {name: values for name, values in arrays.items() if values.dtype.kind in "fiub"}
    arrays["one_plus_error_estimate"] = np.asarray(1 + dataset.attrs["error_estimate"])
    return arrays


def of_json(content: Any, name: str = "") -> Arrays:
    """Numbers in JSON by their path; lists of numbers as arrays, null as NaN, strings left out."""
    if isinstance(content, dict):
        parts = {str(key): part for key, part in content.items() if key not in WALL_TIMES}
    elif isinstance(content, list | tuple):
        try:
            array = np.array(content, float)  # None becomes NaN
        except (TypeError, ValueError):
            parts = {str(i): part for i, part in enumerate(content)}
        else:
            return {name: array}
    elif isinstance(content, str):
        return {}
    else:
        return {name: np.array(content, float)}
    arrays: Arrays = {}
    for key, part in parts.items():
        arrays |= of_json(part, f"{name}.{key}" if name else key)
    return arrays


def of_command(*words: str, file: str = "", cache: Path | None = None) -> Arrays:
    """Numbers that `python -m jaxbeam COMMAND CASE ... --json` prints for a case `file` (text).

    Raises RuntimeError with the message of the command if it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "case.toml"
        path.write_text(file, encoding="utf-8")
        command = [sys.executable, "-m", "jaxbeam", words[0], str(path), *words[1:], "--json"]
        environment = os.environ | ({} if cache is None else {"XDG_CACHE_HOME": str(cache)})
        process = subprocess.run(
            command, capture_output=True, text=True, cwd=REPOSITORY, env=environment
        )
    if process.returncode:
        message = (process.stderr.strip() or "no message").splitlines()[-1]
        raise RuntimeError(f"jaxbeam {' '.join(words)}: {message}")
    return of_json(json.loads(process.stdout))


def named(**parts: Arrays) -> Arrays:
    """Arrays of several runs under the name of each."""
    return {f"{run}.{name}": array for run, some in parts.items() for name, array in some.items()}
