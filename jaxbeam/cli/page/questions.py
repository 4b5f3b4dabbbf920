"""Requests of the page ("questions") and their answers, through the server or a web worker.

A question is a name and a table; an answer a table, or bytes with their media type. Downloads are
files, pictures, a report, and the same run in Python or as a command.
"""

import json
import shlex
import struct
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxbeam as jb
from jaxbeam.case.library.published import trains
from jaxbeam.case.loads.vehicles import vehicle_names
from jaxbeam.cli.page import views
from jaxbeam.cli.page.workspace import Workspace
from jaxbeam.model.plausibility.check import leave_warnings_to_caller

KINDS = {
    "csv": "text/csv",
    "xlsx": "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet",
    "nc": "application/x-netcdf",
    "png": "image/png",
    "svg": "image/svg+xml",
    "gif": "image/gif",
    "toml": "application/toml",
    "html": "text/html",
}


def take(workspace: Workspace, text: str, what: str) -> tuple[str, bytes, str]:
    """Name, content and media type of a file of the run of a case; `what` is its ending.

    Raises ValueError for an ending that is none of KINDS.
    """
    if what not in KINDS:
        raise ValueError(f"{what!r} is none of the files to take away: {', '.join(KINDS)}")
    if what == "toml":
        return "case.toml", text.encode(), KINDS[what]
    record = workspace.record(text)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"run.{what}"
        _write(what, record, path)
        return path.name, path.read_bytes(), KINDS[what]


def _write(what: str, record: "jb.Record", path: Path) -> None:
    writers: dict[str, Callable[[], Any]] = {
        "gif": lambda: _animate(record, path),
        "html": lambda: path.write_text(report(record), encoding="utf-8"),
        "png": lambda: _draw(record, path),
        "svg": lambda: _draw(record, path),
    }
    writers.get(what, lambda: jb.save(record, path))()


def _animate(record: "jb.Record", path: Path) -> None:
    from jaxbeam.plot import animate

    animate(record, path)


def _draw(record: "jb.Record", path: Path) -> None:
    from jaxbeam.plot import plot_record

    plot_record(record).savefig(path)


def report(record: "jb.Record") -> str:
    """HTML report of a run for printing: title, peaks, contact forces, picture and case."""
    from jaxbeam.files.case_file import case_to_dict
    from jaxbeam.files.report import ReportFigure, ReportSection, ReportTable, html
    from jaxbeam.plot import plot_record

    content = jb.api.content(record)

    def number(value):
        return "-" if value is None else f"{value:.5g}"

    sensors = ReportTable(
        ("sensor", "quantity", "unit", "smallest", "at (s)", "largest", "at (s)", "amplification"),
        [
            (s["name"], s["quantity"], s["unit"], *(number(s[key]) for key in PEAKS))
            for s in content["sensors"]
        ],
    )
    forces = zip(content["lowest_contact_force"], content["largest_contact_force"], strict=True)
    rows = [(str(i), number(low), number(high)) for i, (low, high) in enumerate(forces)]
    wheels = ReportTable(("wheel", "lowest on the beam (N)", "largest at samples (N)"), rows)
    parts = case_to_dict(record.case)
    entries = [(key, _short(value)) for key, value in parts.items() if key != "title"]
    picture = ReportFigure("histories of the run", plot_record(record), embedded=True)
    return html(
        record.case.title or "Run",
        [
            ReportSection("", [content["verdict"]]),
            ReportSection("Sensors", [sensors, picture]),
            *([ReportSection("Wheels", [wheels])] if rows else []),
            ReportSection("Case (SI units)", [ReportTable(("part", "numbers"), entries)]),
            ReportSection("", [f"jaxbeam {jb.__version__}"]),
        ],
    )


PEAKS = ("smallest", "smallest_time", "largest", "largest_time", "dynamic_amplification")


def _short(value: Any) -> str:
    text = ", ".join(f"{k} = {v}" for k, v in value.items()) if isinstance(value, dict) else ""
    text = text or "; ".join(map(_short, value))
    return text if len(text) < 600 else f"{text[:600]} ..."


def words(workspace: Workspace, text: str, name: str | None) -> dict[str, str]:
    """Texts of the same run in Python and as a command, for a case in a file of a name."""
    file = name or "case.toml"
    case = workspace.case(text)
    python = [
        "import jaxbeam as jb",
        "",
        f"case = jb.load_case({file!r})",
        "record = jb.simulate(case)",
        "print(record.verdict)",
        "print(record.extremes)" if case.sensors else "print(record.contact_force.max(axis=0))",
    ]
    return {"python": "\n".join(python), "command": f"jaxbeam simulate {shlex.quote(file)} --plot"}


class Content(NamedTuple):
    """Answer in bytes, with its media type, and a file name if it is downloaded."""

    body: bytes
    kind: str
    name: str | None = None


def packed(words: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Content:
    """Words as JSON and arrays as 32-bit floats in one answer.

    First the length of the JSON (32 bits, little-endian), then the JSON, padded to 4 bytes, with
    the shapes of the arrays, then their numbers one after the other.
    """
    content = {name: np.ascontiguousarray(array, "<f4") for name, array in arrays.items()}
    shapes = {name: list(array.shape) for name, array in content.items()}
    head = json.dumps(jb.api.plain({**words, "arrays": shapes}), allow_nan=False).encode()
    head += b" " * (-len(head) % 4)
    body = struct.pack("<I", len(head)) + head + b"".join(map(bytes, content.values()))
    return Content(body, "application/octet-stream")


def questions(
    workspace: Workspace, opened: str | None = None
) -> dict[str, Callable[[dict[str, Any]], Any]]:
    """Functions that answer questions about a workspace, by name; `opened` is its first file."""

    def hello(_) -> dict[str, Any]:
        return {
            "opened": opened,
            "folder": workspace.folder.name,
            "files": workspace.files(),
            "library": workspace.library(),
            "names": names,
        }

    offsets = [{"name": name, "offsets": train.offsets} for name, train in trains().items()]
    names = {"model": vehicle_names(), "train": list(trains())}

    def run(question) -> Content:
        record = workspace.record(question["text"])
        return packed(*views.pictures(record))

    def preview(question) -> Any:
        text, values, ranges = question["text"], question["values"], question["ranges"]
        if question.get("prepare"):
            workspace.simulator(workspace.case(text), values, ranges)
            return {}
        record = workspace.preview(text, values, ranges)
        words, arrays = views.pictures(record)
        return packed(words | {"scene": views.scene(record.case)}, arrays)

    def schema(_) -> dict[str, Any]:
        from jaxbeam.files.json_schema import json_schema

        return json_schema()

    def download(question) -> Content:
        name, content, kind = take(workspace, question["text"], question["what"])
        return Content(content, kind, name)

    return {
        "hello": hello,
        "schema": schema,
        "open": lambda q: workspace.read(q["name"]),
        "library": lambda q: {"text": workspace.library_text(q["name"])},
        "save": lambda q: workspace.save(q["name"], q["text"], q.get("mark")),
        "model": lambda q: workspace.model(q["text"]),
        "change": lambda q: {"text": workspace.change(q["text"], q["changes"])},
        "run": run,
        "preview": preview,
        "envelopes": lambda q: views.envelopes(workspace.record(q["text"])),
        "take": download,
        "sweep": lambda q: {"job": workspace.start_sweep(q["text"], q["axes"])},
        "read-log": lambda q: workspace.read_log(q["name"], q["columns"], q["rate"], q["missing"]),
        "fit": lambda q: {"job": workspace.start_fit(q["text"], q["logs"], q["free"])},
        "modes": lambda q: {
            "job": workspace.start_modes(q["logs"], q.get("band"), q.get("choose", ()))
        },
        "compare": lambda q: {"job": workspace.start_comparison(q["text"], q["names"])},
        "tune": lambda q: {
            "job": workspace.start_tuning(q["text"], q["free"], q["vary"], q["spread"], q["steps"])
        },
        "controllers": lambda _: {"names": workspace.controllers()},
        "job": lambda q: workspace.job(q["job"], q.get("known", 0), q.get("name") or "case.toml"),
        "cancel": lambda q: workspace.cancel(q["job"]) or {},
        "vehicles": lambda _: {"vehicles": views.vehicles(), "trains": offsets},
        "words": lambda q: words(workspace, q["text"], q.get("name")),
    }


def answer(work: Callable[[dict[str, Any]], Any], text: str | bytes) -> tuple[bool, Content]:
    """Whether a question in JSON was answered, and its answer or the problem, as bytes."""
    try:
        found = work(_question(text))
    except (ValueError, KeyError, OSError, RuntimeError, ImportError, TypeError) as error:
        return False, as_json({"problem": problem_of(error)})
    return True, found if isinstance(found, Content) else as_json(found)


def _question(text: str | bytes) -> dict[str, Any]:
    question = json.loads(text)
    if not isinstance(question, dict):
        raise ValueError("a question is a table")
    if not isinstance(question.get("text", ""), str):
        raise ValueError("the text of a question is text")
    return question


def problem_of(error: Exception) -> dict[str, Any]:
    """Message and address of an error, as data for the page."""
    problem = jb.api.problem(error)._asdict()
    if isinstance(error, KeyError):
        problem["message"] = f"the question lacks {error}"
    return problem


def as_json(found: Any) -> Content:
    """Answer in JSON, of plain data."""
    body = json.dumps(jb.api.plain(found), ensure_ascii=False, allow_nan=False)
    return Content(body.encode(), "application/json")


# Answers to the page that runs without a server: Python itself is in the browser (`worker.js`).

FOLDER = Path("cases")  # of the file system that the browser forgets


class Page:
    """Page of a folder: takes questions by name and JSON, returns answers as bytes."""

    def __init__(self, folder: Path = FOLDER):
        folder.mkdir(exist_ok=True)
        leave_warnings_to_caller()  # the page shows them
        self._workspace = Workspace(folder)
        self._questions = questions(self._workspace)

    def ask(self, name: str, text: str) -> tuple[bool, bytes, str, str]:
        """Whether a question was answered, the answer or problem, its media type, a file name."""
        answered, content = answer(self._questions[name], text)
        return answered, content.body, content.kind, content.name or ""

    def close(self) -> None:
        """Cancel all work and remove the logs."""
        self._workspace.close()
