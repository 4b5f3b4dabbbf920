"""Fits on disk: the parameters found, with the case and the logs, in one file."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from tuning.checkpoint import read_arrays, save
from tuning.fit.dataset import make_dataset
from tuning.fit.least_squares import LeastSquares
from tuning.fit.multi_start import LocalMinimum
from tuning.fit.result import Fit
from tuning.logs.log import Log
from tuning.parameters.free import FreeParameter
from tuning.parameters.prior import Prior

FORMAT, FORMER_FORMAT = "jaxbeam fit 2", "jaxbeam fit 1"
_FIT_ARRAYS = ("values", "errors", "correlation", "noise", "fitted", "autocorrelation_factor")
_LOG_ARRAYS = ("times", "values", "valid")
_LOG_FIELDS = (
    "names",
    "quantities",
    "units",
    "sensors",
    "positions",
    "actuators",
    "notes",
    "vehicle_sensors",
)


def save_fit(fit: Fit, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a fit with its logs and case to a file (.npz), without any loss of precision.

    Raises FileExistsError if the file exists and `overwrite` is not set.

    >>> import tuning
    >>> tuning.save_fit(tuning.load_fit("fit.npz"), "copy.npz")
    """
    logs = fit.dataset.logs
    header = {
        "case": case_to_dict(fit.case),
        "nominal_case": case_to_dict(fit.dataset.nominal_case),
        "parameters": [dataclasses.asdict(parameter) for parameter in fit.parameters],
        "unidentifiable": fit.unidentifiable,
        "search": fit.search,
        "degrees_of_freedom": fit.degrees_of_freedom,
        "loss": fit.least_squares.loss,
        "logs": [_log_header(log, fit.case) for log in logs],
        "minima": [[m.cost, m.starts, m.converged] for m in fit.minima],
    }
    arrays = {name: getattr(fit, name) for name in _FIT_ARRAYS}
    for i, log in enumerate(logs):
        arrays |= {f"log{i}.{name}": getattr(log, name) for name in _LOG_ARRAYS}
    for i, found in enumerate(fit.minima):
        arrays |= {f"minimum{i}.values": found.values, f"minimum{i}.point": found.unbounded}
    save(path, FORMAT, arrays | {"about": np.array(json.dumps(header))}, overwrite)


def load_fit(path: str | os.PathLike) -> Fit:
    """Fit from a file written by `save_fit`.

    Raises ValueError if there is no such file, or it is damaged or no fit, OSError if it cannot be
    read.

    >>> import tuning
    >>> print(str(tuning.load_fit("fit.npz")).splitlines()[3])
    beam.flexural_rigidity  N m^2   12.1      11  10.545 to 11.455
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: there is no such fit; name the .npz file that identify wrote")
    arrays, header = _read(path)
    nominal_case = case_from_dict(header["nominal_case"])
    beam = header["nominal_case"]["beam"]
    logs = [_read_log(i, entry, beam, arrays) for i, entry in enumerate(header["logs"])]
    parameters = [
        FreeParameter(**{**entry, "prior": Prior(**entry["prior"])})
        for entry in header["parameters"]
    ]
    dataset = make_dataset(nominal_case, logs)
    minima = [
        LocalMinimum(
            cost, arrays[f"minimum{i}.values"], arrays[f"minimum{i}.point"], starts, converged
        )
        for i, (cost, starts, converged) in enumerate(header["minima"])
    ]
    return Fit(
        parameters=parameters,
        **{name: arrays[name] for name in _FIT_ARRAYS},
        unidentifiable=header["unidentifiable"],
        search=header.get("search") or header["verdict"],  # so called before 0.3
        case=case_from_dict(header["case"]),
        dataset=dataset,
        degrees_of_freedom=header["degrees_of_freedom"],
        least_squares=LeastSquares(dataset, parameters, header["loss"]),
        minima=tuple(minima),
    )


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict]:
    """Arrays and header of a file. Raises ValueError if it is no fit of the present format."""
    arrays = read_arrays(path, "fit")
    found = str(arrays.pop("fingerprint", ""))
    if found == FORMER_FORMAT:
        raise ValueError(f"{path} was written by jaxbeam 0.1: identify from the logs again")
    if found != FORMAT or "about" not in arrays:
        raise ValueError(
            f"{path} is a NumPy archive, but no fit; name the .npz file that identify wrote"
        )
    return arrays, json.loads(str(arrays["about"]))


def _log_header(log: Log, case: Case) -> dict:
    """Names, units and sources of a log as plain data; loads as in a case file."""
    header = {name: getattr(log, name) for name in _LOG_FIELDS} | {
        "source": log.source,
        "loads": None,
    }
    if log.loads is not None:
        with_loads = dataclasses.replace(case, loads=tuple(log.loads), controller=None)
        header["loads"] = case_to_dict(with_loads).get("loads", [])
    return header


def _read_log(index: int, header: dict, beam: dict, arrays) -> Log:
    loads = header["loads"]
    if loads is not None:
        loads = case_from_dict({"beam": beam, "loads": loads}).loads
    words = {name: tuple(header[name]) for name in _LOG_FIELDS if name in header}
    own = {name: arrays[f"log{index}.{name}"] for name in _LOG_ARRAYS}
    return Log(**own, **words, source=header["source"], loads=loads)
