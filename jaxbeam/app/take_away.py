"""Downloads of the page: files, pictures, a report, and the same run in Python or as a command."""

import shlex
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jaxbeam as jb
from jaxbeam.app.workspace import Workspace

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
    wheels = ReportTable(("wheel", "lowest contact force (N)", "largest (N)"), rows)
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
