"""A folder of case files, and computations for the text of a case, independent of the web.

Texts come with each question, so that two pages, or one that was loaded again, do not disturb each
other; the last results are cached by text.

The text of a case file under changes: comments, order and units of what stays are kept.
"""

import collections
import hashlib
import itertools
import os
import re
import tempfile
import threading
import warnings
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tomlkit
from tomlkit.exceptions import ParseError
from tomlkit.items import AoT, Array, Table

import jaxbeam as jb
from jaxbeam.case.case import (
    Case,
    address_words,
    addresses,
    leaves_by_address,
    part_classes,
    unit_at,
)
from jaxbeam.case.fields import concrete
from jaxbeam.case.library.rigs import RIG_NAMES
from jaxbeam.case.toml_file import is_quantity, number_and_unit, number_in_si, parse_toml
from jaxbeam.cli.page import studies, views
from jaxbeam.files.case_file import load_controller
from jaxbeam.runtime.input_file import read_input, read_text_input
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.simulation.simulate import ContactLossWarning


def changed(text: str, changes: Iterable[Mapping[str, Any]], case: Case | None = None) -> str:
    """Text of a case file after changes, one after the other.

    A change is {"set": address, "to": value} or {"remove": address}. Addresses are the words of
    the file, as loads.0.speed; the one after the last of a list, with a table, adds to it. A number
    that takes the place of a text with a unit is in SI units and keeps that unit, as far as the
    `case` of the text is known. Raises ValueError for text that is not TOML and for addresses that
    it does not have.

    >>> print(changed("[beam]\\nlength = 2.0  # m, all\\n", [{"set": "beam.length", "to": 3}]))
    [beam]
    length = 3  # m, all
    <BLANKLINE>
    """
    try:
        document = tomlkit.parse(text)
    except ParseError as error:
        raise ValueError(f"not valid TOML: {error}") from None
    for change in changes:
        if "remove" in change:
            _remove(document, change["remove"].split("."))
        else:
            _set(document, change["set"], change["to"], case)
    return tomlkit.dumps(document)


def _set(document: Any, address: str, value: Any, case: Case | None) -> None:
    *parents, last = address.split(".")
    node = document
    for depth, key in enumerate(parents):
        if isinstance(node, dict) and key not in node:
            listed = depth == 0 and key in part_classes() and part_classes()[key].listed
            in_table = (*parents, last)[depth + 1].isdigit()
            node[key] = tomlkit.aot() if listed or in_table else tomlkit.table()
        node = _child(node, key, address)
    if isinstance(node, list):
        _set_entry(node, last, value, address)
    elif isinstance(node, dict):
        node[last] = _as_before(node.get(last), value, address, case)
    else:
        raise ValueError(f"there is no place {address} in the file")


def _set_entry(node: Any, last: str, value: Any, address: str) -> None:
    index = int(last) if last.isdigit() else -1
    if not 0 <= index <= len(node):
        raise ValueError(f"there is no place {address} in the file")
    if isinstance(value, dict) and isinstance(node, AoT):
        value = _table(value)
    if index == len(node):
        node.append(value)
    elif isinstance(node, AoT):
        node[index].clear()
        for key, entry in value.items():
            node[index][key] = entry
    else:
        node[index] = value


def _table(content: Mapping[str, Any]) -> Table:
    table = tomlkit.table()
    for key, value in content.items():
        table[key] = value
    table.add(tomlkit.nl())
    return table


def _as_before(old: Any, value: Any, address: str, case: Case | None) -> Any:
    """Number in SI units, as a text in the unit of the old value if that had a unit."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if case is None or not is_number or not is_quantity(old):
        return value
    unit = number_and_unit(str(old))[1]
    try:
        factor = number_in_si(f"1 {unit}", unit_at(case, address), address)
    except ValueError:
        return value
    return f"{value / factor:.12g} {unit}"


def _remove(document: Any, path: list[str]) -> None:
    *parents, last = path
    address = ".".join(path)
    node = document
    for key in parents:
        node = _child(node, key, address)
    if isinstance(node, list) and last.isdigit() and int(last) < len(node):
        del node[int(last)]
        if not len(node) and isinstance(node, AoT | Array) and len(parents) == 1:
            del document[parents[0]]
    elif isinstance(node, dict) and last in node:
        del node[last]
    else:
        raise ValueError(f"there is no {address} in the file")


def _child(node: Any, key: str, address: str) -> Any:
    if isinstance(node, dict) and key in node:
        return node[key]
    if isinstance(node, list) and key.isdigit() and int(key) < len(node):
        return node[int(key)]
    raise ValueError(f"there is no place {address} in the file")


KEPT = 6  # cases, records and simulators in the caches
PREVIEW_TOLERANCE, PREVIEW_SAMPLES = 3e-2, 201  # of pictures while a slider moves
MAX_BYTES = 2 * 2**20  # of the text of a case
_STARTERS = resources.files("jaxbeam") / "files" / "starters"


class ResultCache:
    """Cache of results for the last few keys."""

    def __init__(self, size: int = KEPT):
        self._size, self._found = size, collections.OrderedDict()

    def get(self, key: Any, compute: Any) -> Any:
        """Result for a key, computed by `compute` if it is not cached."""
        if key not in self._found:
            self._found[key] = compute()
        self._found.move_to_end(key)
        while len(self._found) > self._size:
            self._found.popitem(last=False)
        return self._found[key]


class Workspace:
    """Cases in a folder, and computations for texts of cases; one computation at a time.

    All methods raise ValueError with one sentence for what is wrong in a text, OSError for files.
    """

    def __init__(self, folder: str | os.PathLike):
        self.folder = Path(folder).resolve()
        self._cases, self._records, self._simulators = ResultCache(), ResultCache(), ResultCache()
        self._library = ResultCache(100)
        self._jobs: dict[str, Any] = {}
        self._log_options: dict[str, dict[str, Any]] = {}
        self._uploads = tempfile.TemporaryDirectory(prefix="jaxbeam-")
        self._numbers = itertools.count(1)
        self._computing = threading.RLock()

    # Files

    def files(self) -> list[str]:
        """Names of the TOML files of the folder."""
        return sorted(path.name for path in self.folder.glob("*.toml"))

    def _place(self, name: str) -> Path:
        """Path of a file of the folder. Raises ValueError for any other place."""
        path = self.folder / name
        plain = re.fullmatch(r"[^./\\\0][^/\\\0]*\.toml", name) is not None
        if not plain or path.resolve().parent != self.folder:
            raise ValueError(
                f"{name!r} is no place for a case: give a name that ends with .toml, of a file in"
                f" the folder {self.folder.name}"
            )
        return path

    def read(self, name: str) -> dict[str, Any]:
        """Text of a case file, and a mark (hash) that reveals a later change of the file.

        Raises ValueError for a place outside the folder and for a file that is too large.
        """
        path = self._place(name)
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"{name} has more than the {MAX_BYTES >> 20} MB of a case file")
        text = read_text_input(path, "case file")
        return {"name": name, "text": text, "mark": _mark(text)}

    def save(self, name: str, text: str, mark: str | None = None) -> dict[str, Any]:
        """Write a text to a file of the folder, whole or not at all.

        `mark` is that of the file as it was read; a file that has changed since, or that was not
        read, is left alone. Raises FileExistsError then, ValueError for a place outside the folder.
        """
        path = self._place(name)
        if path.exists() and _mark(_text_of(path)) != mark:
            raise FileExistsError(
                f"{name} has been changed by someone else, or is another file: save under another"
                " name, or open it again"
            )
        with whole_file(path, overwrite=True) as partial:
            partial.write_bytes(text.encode("utf-8"))
        return {"name": name, "mark": _mark(text)}

    def library(self) -> list[dict[str, Any]]:
        """Cases to start from: name, title, group, and scene for a picture."""
        found = []
        for group, names in (("Starters", _starters()), ("Published rigs", RIG_NAMES)):
            for name in names:
                case = self._library_case(name)
                entry = {"name": name, "title": case.title, "group": group}
                found.append(entry | {"scene": views.scene(case)})
        return found

    def _library_case(self, name: str) -> Case:
        return self._library.get(name, lambda: jb.api.load_case(self.library_text(name)))

    def library_text(self, name: str) -> str:
        """Text of a case to start from. Raises ValueError if there is none of the name."""
        if name in _starters():
            place = _STARTERS
        elif name in RIG_NAMES:
            place = resources.files("jaxbeam.case.library.rigs")
        else:
            raise ValueError(f"there is no case {name!r} to start from")
        return read_text_input(str(place / f"{name}.toml"), "case file")

    # Cases

    def case(self, text: str) -> Case:
        """The validated case of a text."""
        return self._cases.get(text, lambda: jb.api.load_case(text, folder=self.folder))

    def model(self, text: str) -> dict[str, Any]:
        """Tables of a text, and the picture and numbers of its case, or the error in it.

        `numbers` are those of the case by address, with units and words.
        """
        found: dict[str, Any] = {"tables": {}, "problem": None}
        try:
            found["tables"] = parse_toml(text)
            with self._computing:
                case = self.case(text)
                plausibility = jb.check(case)
        except ValueError as error:
            problem = jb.api.problem(error)._asdict()
            return jb.api.plain(found) | {"problem": problem}
        numbers = {
            address: {
                "value": float(concrete(number)),
                "unit": unit_at(case, address),
                "words": address_words(case, address),
            }
            for address, number in addresses(case).items()
            if np.ndim(number) == 0
        }
        found |= {
            "scene": views.scene(case),
            "numbers": numbers,
            "plausibility": {"line": str(plausibility), "warnings": list(plausibility.warnings)},
        }
        return jb.api.plain(found)

    def change(self, text: str, changes: Iterable[Mapping[str, Any]]) -> str:
        """Text after changes; see `changed`."""
        try:
            case = self.case(text)
        except ValueError:  # the text is not valid yet
            case = None
        return changed(text, changes, case)

    # Runs

    def record(self, text: str) -> "jb.Record":
        """Record of the run of the case of a text."""

        def compute():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ContactLossWarning)  # the verdict says so
                return jb.simulate(self.case(text))

        with self._computing:
            return self._records.get(text, compute)

    def simulator(
        self, case: Case, values: Mapping[str, float], ranges: Mapping[str, Any]
    ) -> "jb.Simulator | None":
        """Simulator for numbers within ranges; None where they change the structure of the case.

        That is, where they change the order of parts along the beam, or the duration. It is the
        same for all cases that differ in these numbers only.
        """
        vary = {address: tuple(ranges[address]) for address in values if address in ranges}
        leaves = leaves_by_address(case)
        others = {a: np.asarray(leaf).tobytes() for a, leaf in leaves.items() if a not in values}
        times = np.linspace(0.0, float(concrete(case.run.duration)), PREVIEW_SAMPLES)
        key = (jax.tree.structure(case), tuple(others.items()), tuple(vary.items()), tuple(values))

        def prepare():
            try:
                return jb.Simulator(case, vary or tuple(values), times, PREVIEW_TOLERANCE)
            except ValueError:
                return None

        with self._computing:
            return self._simulators.get(key, prepare)

    def preview(
        self, text: str, values: Mapping[str, float], ranges: Mapping[str, Any] | None = None
    ) -> "jb.Record":
        """Record of a run with other numbers, coarser than `record`, for a moving slider.

        Its steps are chosen once for the `ranges` (low, high) of the numbers; beyond them, and
        where the numbers change the structure of the case, they are chosen anew.
        """
        case, values = self.case(text), dict(values)
        with self._computing, warnings.catch_warnings():
            warnings.simplefilter("ignore", ContactLossWarning)
            simulator = self.simulator(case, values, ranges or {})
            if simulator is not None:
                try:
                    return simulator(values)
                except ValueError:  # beyond its ranges
                    pass
            return jb.simulate(jb.replace(case, values), tolerance=PREVIEW_TOLERANCE)

    # Work that takes long

    def start_sweep(self, text: str, axes: Iterable[Mapping[str, Any]]) -> str:
        """Job number of a newly started sweep."""
        return self._start_study(studies.Sweep(self.case(text), list(axes)))

    def start_fit(self, text: str, names: Iterable[str], free: Mapping[str, Any]) -> str:
        """Job number of a newly started fit of free numbers to uploaded logs.

        Raises ValueError without a log or without a free number.
        """
        logs = [log for name in names for log in self.log(name)]
        if not logs or not free:
            raise ValueError("a fit needs a log and a free number at least")
        return self._start_study(studies.PageFit(self.case(text), logs, dict(free)))

    def start_modes(
        self, names: Iterable[str], band: Sequence[float] | None, choose: Sequence[float]
    ) -> str:
        """Job number of a newly started identification of modes from uploaded logs.

        Raises ValueError without a log.
        """
        logs = [log for name in names for log in self.log(name)]
        if not logs:
            raise ValueError("drop a log on the page: modes are found in it")
        return self._start(jb.api.Job(studies.modes, logs, band, list(choose)))

    def start_comparison(self, text: str, names: Iterable[str]) -> str:
        """Job number of a newly started comparison of the controllers of a case and of files."""
        case, found = self.case(text), {}
        if case.controller is not None:
            found["this case"] = case.controller
        for name in names:
            found[name.removesuffix(".toml")] = load_controller(self._place(name))
        return self._start(jb.api.Job(studies.compare, case, found))

    def start_tuning(self, text: str, free: Mapping[str, Any], vary: str, spread, steps) -> str:
        """Job number of a newly started tuning of numbers of a controller."""
        parts = self.case(text), dict(free), vary, float(spread), int(steps)
        return self._start_study(studies.PageTuning(*parts))

    def controllers(self) -> list[str]:
        """Names of the files of the folder that have a controller."""
        found = []
        for name in self.files():
            try:
                if "controller" in parse_toml(self.read(name)["text"]):
                    found.append(name)
            except (ValueError, OSError):  # no case, or none that can be read
                continue
        return found

    def take_log(self, name: str, content: bytes) -> dict[str, Any]:
        """Columns, units and faults of an uploaded log, which is stored for later fits.

        The file of a description that belongs to a log, as run.toml to run.csv, is kept for it.
        Raises ValueError for what is no log.
        """
        studies.keep_log(Path(self._uploads.name), name, content)
        self._log_options.pop(name, None)
        if name.lower().endswith(".toml"):
            return {"name": name, "logs": [], "problem": None}
        return self.read_log(name)

    def read_log(
        self, name: str, columns: str = "", rate: str = "", missing: str = "refuse"
    ) -> dict[str, Any]:
        """Columns of an uploaded log, read with other columns and units, rate and gaps.

        They are as of `tuning.read_logs`, "" for what the file itself tells; later fits read it in
        the same way. Returns what is read, or the `problem` for which it cannot be.
        """
        if name in self._log_options or columns.strip() or rate.strip() or missing != "refuse":
            self._log_options[name] = {
                "columns": columns.strip() or None,
                "rate": number_in_si(rate, "Hz", "rate") if rate.strip() else None,
                "missing": missing,
            }
        try:
            logs = [studies.describe_log(log) for log in self.log(name)]
        except (ValueError, ImportError) as error:
            problem = jb.api.problem(error)._asdict()
            problem["message"] = problem["message"].replace(f"{self._uploads.name}/", "")
            return {"name": name, "logs": [], "problem": problem}
        return {"name": name, "logs": logs, "problem": None}

    def log(self, name: str) -> list[Any]:
        """Logs of an uploaded file. Raises ValueError if there was none of the name."""
        path = Path(self._uploads.name) / Path(name).name
        if not path.is_file():
            raise ValueError(f"there is no log {name!r}: drop it on the page again")
        return studies.read_logs(path, self._log_options.get(name, {}))

    def _start_study(self, study: Any) -> str:
        """Job number of a newly started study, whose partial results are shown."""
        return self._start(jb.api.Job(study.run), study)

    def _start(self, job: "jb.api.Job", study: Any = None) -> str:
        """Number of a job, which is stored among the last few."""
        number = str(next(self._numbers))
        self._jobs[number] = job, study
        for old in list(self._jobs)[:-KEPT]:
            self._jobs.pop(old)[0].cancel()
        return number

    def job(self, number: str, known: int = 0, name: str = "case.toml") -> dict[str, Any]:
        """State of a job: its progress, whether it is done, and its result or error.

        `seen` has the results of a sweep, a fit or a tuning so far, without the first `known` rows
        or points; texts to compute them again name the case file `name`. Raises ValueError for an
        unknown number.
        """
        job, study = self._known_job(number)
        state: dict[str, Any] = {"done": job.done, "progress": list(job.progress), "problem": None}
        if study is not None:
            state["seen"] = study.state(known, name)
        if state["done"]:
            try:
                state["result"] = job.result()
            except jb.api.Cancelled:
                state["problem"] = jb.api.Problem("stopped")._asdict()
            except Exception as error:  # any error of a job is shown on the page
                state["problem"] = jb.api.problem(error)._asdict()
        return state

    def cancel(self, number: str) -> None:
        """Cancel a job. Raises ValueError for an unknown number."""
        self._known_job(number)[0].cancel()

    def _known_job(self, number: str) -> Any:
        if number not in self._jobs:
            raise ValueError("this work is no longer known: start it again")
        return self._jobs[number]

    def close(self) -> None:
        """Cancel all jobs, and remove the logs."""
        for job, _ in self._jobs.values():
            job.cancel()
        self._uploads.cleanup()


def _starters() -> list[str]:
    return sorted(one.name.removesuffix(".toml") for one in _STARTERS.iterdir())


def _mark(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _text_of(path: Path) -> str:
    """Text of a file, with a replacement character for each byte that is none."""
    return read_input(path, "case file").decode("utf-8-sig", "replace")
