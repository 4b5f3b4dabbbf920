"""A fit on disk: everything it came from and everything it found, in one file."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from tuning.checkpoint import load, save
from tuning.fit.dataset import prepare
from tuning.fit.identify import Fit
from tuning.fit.least_squares import Search
from tuning.fit.multi_start import Minimum
from tuning.logs.log import Log
from tuning.parameters.free import Free
from tuning.parameters.prior import Belief

FORMAT = "jaxbeam fit 1"
_ARRAYS = ("values", "errors", "correlation", "noise", "fitted", "colour")
_LOG_ARRAYS = ("times", "values", "valid")
_WORDS = ("names", "quantities", "units", "sensors", "positions", "actuators", "notes")


def save_fit(fit: Fit, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a fit to a file (.npz), with its logs and case, to the last bit.

    Raises FileExistsError if the file exists and `overwrite` is not set.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists already; choose another name, or overwrite it")
    logs = fit.campaign.logs
    about = {
        "case": case_to_dict(fit.case),
        "given": case_to_dict(fit.campaign.given),
        "numbers": [dataclasses.asdict(number) for number in fit.numbers],
        "unseen": fit.unseen,
        "verdict": fit.verdict,
        "freedom": fit.freedom,
        "loss": fit.search.loss,
        "logs": [_about(log, fit.case) for log in logs],
        "minima": [[m.cost, m.starts, m.converged] for m in fit.minima],
    }
    arrays = {name: getattr(fit, name) for name in _ARRAYS}
    for i, log in enumerate(logs):
        arrays |= {f"log{i}.{name}": getattr(log, name) for name in _LOG_ARRAYS}
    for i, found in enumerate(fit.minima):
        arrays |= {f"minimum{i}.values": found.values, f"minimum{i}.point": found.point}
    save(path, FORMAT, arrays | {"about": np.array(json.dumps(about))})


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
    about = json.loads(str(arrays["about"]))
    logs = [_log(i, entry, about["given"]["beam"], arrays) for i, entry in enumerate(about["logs"])]
    numbers = [Free(**{**n, "belief": Belief(**n["belief"])}) for n in about["numbers"]]
    campaign = prepare(case_from_dict(about["given"]), logs)
    minima = [
        Minimum(cost, arrays[f"minimum{i}.values"], arrays[f"minimum{i}.point"], starts, converged)
        for i, (cost, starts, converged) in enumerate(about["minima"])
    ]
    return Fit(
        numbers=numbers,
        **{name: arrays[name] for name in _ARRAYS},
        unseen=about["unseen"],
        verdict=about["verdict"],
        case=case_from_dict(about["case"]),
        campaign=campaign,
        freedom=about["freedom"],
        search=Search(campaign, numbers, about["loss"]),
        minima=tuple(minima),
    )


def _about(log: Log, case: Case) -> dict:
    """What a log says of itself, as plain words and numbers; loads as in a case file."""
    about = {name: getattr(log, name) for name in _WORDS} | {"source": log.source, "loads": None}
    if log.loads is not None:
        with_loads = dataclasses.replace(case, loads=tuple(log.loads), controller=None)
        about["loads"] = case_to_dict(with_loads).get("loads", [])
    return about


def _log(number: int, about: dict, beam: dict, arrays) -> Log:
    loads = about["loads"]
    if loads is not None:
        loads = case_from_dict({"beam": beam, "loads": loads}).loads
    words = {name: tuple(about[name]) for name in _WORDS}
    own = {name: arrays[f"log{number}.{name}"] for name in _LOG_ARRAYS}
    return Log(**own, **words, source=about["source"], loads=loads)
