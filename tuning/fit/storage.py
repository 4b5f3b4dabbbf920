"""A fit on disk: everything it came from and everything it found, in one file."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from tuning.checkpoint import load, save
from tuning.fit.dataset import make_dataset
from tuning.fit.identify import Fit
from tuning.fit.least_squares import LeastSquares
from tuning.fit.multi_start import LocalMinimum
from tuning.logs.log import Log
from tuning.parameters.free import FreeParameter
from tuning.parameters.prior import Prior

FORMAT = "jaxbeam fit 1"
_FIT_ARRAYS = ("values", "errors", "correlation", "noise", "fitted", "colour")
_LOG_ARRAYS = ("times", "values", "valid")
_LOG_FIELDS = ("names", "quantities", "units", "sensors", "positions", "actuators", "notes")


def save_fit(fit: Fit, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a fit to a file (.npz), with its logs and case, to the last bit.

    Raises FileExistsError if the file exists and `overwrite` is not set.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists already; choose another name, or overwrite it")
    logs = fit.dataset.logs
    header = {
        "case": case_to_dict(fit.case),
        "given": case_to_dict(fit.dataset.nominal_case),
        "numbers": [dataclasses.asdict(number) for number in fit.parameters],
        "unseen": fit.unidentifiable,
        "verdict": fit.verdict,
        "freedom": fit.degrees_of_freedom,
        "loss": fit.least_squares.loss,
        "logs": [_log_header(log, fit.case) for log in logs],
        "minima": [[m.cost, m.starts, m.converged] for m in fit.minima],
    }
    arrays = {name: getattr(fit, name) for name in _FIT_ARRAYS}
    for i, log in enumerate(logs):
        arrays |= {f"log{i}.{name}": getattr(log, name) for name in _LOG_ARRAYS}
    for i, found in enumerate(fit.minima):
        arrays |= {f"minimum{i}.values": found.values, f"minimum{i}.point": found.unbounded}
    save(path, FORMAT, arrays | {"about": np.array(json.dumps(header))})


def load_fit(path: str | os.PathLike) -> Fit:
    """Read what `save_fit` wrote. Raises ValueError if it is damaged, or is no fit."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: there is no such fit")
    try:
        arrays = load(path, FORMAT)
    except ValueError:  # what it says of searches would have a fit, or a case, deleted
        raise ValueError(
            f"{path} is no fit, or is damaged; name the .npz file that identify wrote"
        ) from None
    header = json.loads(str(arrays["about"]))
    logs = [
        _read_log(i, entry, header["given"]["beam"], arrays)
        for i, entry in enumerate(header["logs"])
    ]
    parameters = [FreeParameter(**{**n, "belief": Prior(**n["belief"])}) for n in header["numbers"]]
    dataset = make_dataset(case_from_dict(header["given"]), logs)
    minima = [
        LocalMinimum(
            cost, arrays[f"minimum{i}.values"], arrays[f"minimum{i}.point"], starts, converged
        )
        for i, (cost, starts, converged) in enumerate(header["minima"])
    ]
    return Fit(
        parameters=parameters,
        **{name: arrays[name] for name in _FIT_ARRAYS},
        unidentifiable=header["unseen"],
        verdict=header["verdict"],
        case=case_from_dict(header["case"]),
        dataset=dataset,
        degrees_of_freedom=header["freedom"],
        least_squares=LeastSquares(dataset, parameters, header["loss"]),
        minima=tuple(minima),
    )


def _log_header(log: Log, case: Case) -> dict:
    """What a log says of itself, as plain words and numbers; loads as in a case file."""
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
    words = {name: tuple(header[name]) for name in _LOG_FIELDS}
    own = {name: arrays[f"log{index}.{name}"] for name in _LOG_ARRAYS}
    return Log(**own, **words, source=header["source"], loads=loads)
