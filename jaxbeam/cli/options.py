"""Options that several commands share, and what they do: read the case, print the result.

Nothing here imports JAX or NumPy before a case is read, so that help and errors in arguments are
printed within a few tenths of a second; a test checks it.
"""

import dataclasses
import itertools
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

import jaxbeam as jb
from jaxbeam.case.toml_file import read_toml
from jaxbeam.cli.arguments import (
    UsageError,
    check_suffix,
    figure_path,
    parse_assignment,
    parse_size,
    parse_value,
)
from jaxbeam.runtime.output_file import refuse_folder, whole_file
from jaxbeam.runtime.printer import counted, text_table

if TYPE_CHECKING:
    from jaxbeam.model.plausibility.facts import Plausibility
    from tuning import Log

PICTURES = (".png", ".svg", ".pdf")
# Half the effort of the default: 10 ms less for a picture, and files a seventh larger.
PNG_OPTIONS: dict[str, Any] = {"pil_kwargs": {"compress_level": 3}}

Output = Annotated[Path | None, Parameter(("-o", "--output"))]
Free = Annotated[
    tuple[str, ...],
    Parameter(
        help="ADDRESS[=LOW:HIGH]: a free parameter and its bounds, also with units, as"
        " beam.flexural_rigidity='8 GN m^2:12 GN m^2'; repeat it for more."
    ),
]
Over = Annotated[
    tuple[str, ...],
    Parameter(
        help="ADDRESS=START:STOP:COUNT or ADDRESS=V1,V2,...: values of a parameter, with units, as"
        " 60 km/h:200 km/h:15, or words, as loads.0.train=HSLM-A1,HSLM-A2; all combinations are"
        " computed if it is repeated for more."
    ),
]
Starts = Annotated[
    int, Parameter(help="Number of starting points of the search; the first is the case itself.")
]
Seed = Annotated[int, Parameter(help="Seed of random starting points and draws.")]
Resume = Annotated[bool, Parameter(help="Continue what was interrupted, from its output files.")]


@Parameter(name="*")
@dataclass(frozen=True)
class PrintOptions:
    """Options of a command that prints a result."""

    json_: Annotated[bool, Parameter("--json", help="Print the result as JSON.")] = False

    def report(self, content: dict[str, Any], lines: Iterable[str], *written: Path | None) -> None:
        """Print the content as JSON, or else the lines and the names of the files written."""
        if self.json_:
            print(json.dumps(jb.api.plain(content), indent=2, allow_nan=False))
            return
        for line in lines:
            print(line)
        for path in filter(None, written):
            print(f"written: {path}")


@Parameter(name="*")
@dataclass(frozen=True)
class ReadingOptions(PrintOptions):
    """Options of a command that reads a case."""

    set_: Annotated[
        tuple[str, ...],
        Parameter(
            "--set",
            help="ADDRESS=VALUE: change an entry of the case, also with a unit, as"
            " beam.length='25 m'; repeat it for more.",
        ),
    ] = ()

    def check_case(self, path: Path) -> None:
        """Check, before JAX is imported, that a file is TOML and that `--set` has addresses.

        Raises OSError if the file cannot be read, ValueError otherwise.
        """
        for text in self.set_:
            parse_assignment("--set", text)
        read_toml(path)

    def read(self, path: Path, judged: Literal["case", "structure", ""] = "case") -> "jb.Case":
        """Case of a file with the entries of `--set`.

        Warnings of what looks wrong are printed: of all of the case, of its structure alone, or
        none, where the command prints them.

        Raises OSError if the file cannot be read, ValueError for whatever is wrong in it.
        """
        self.check_case(path)
        changes = {
            a: parse_value(v) for a, v in (parse_assignment("--set", text) for text in self.set_)
        }
        enable_compile_cache()
        from jaxbeam.case.case import structure_of
        from jaxbeam.model.plausibility.check import leave_warnings_to_caller

        leave_warnings_to_caller()
        case = jb.api.load_case(path, changes)
        if judged:
            print_warnings(jb.check(case if judged == "case" else structure_of(case)))
        return case


@Parameter(name="*")
@dataclass(frozen=True)
class OutputOptions(PrintOptions):
    """Options of a command that writes files."""

    overwrite: Annotated[bool, Parameter("--overwrite", help="Replace existing files.")] = False

    def check_outputs(self, *paths: Path | None, others: str = "") -> None:
        """Check, before any work, that files can be written; `others` are further ways out.

        Raises FileNotFoundError if the folder does not exist, FileExistsError if the file exists
        and `--overwrite` is not given, or is a folder.
        """
        for path in filter(None, paths):
            if not path.parent.is_dir():
                raise FileNotFoundError(f"there is no folder {path.parent} to write {path.name} to")
            if path.exists() and not self.overwrite:
                ways = f"choose another name or add {others}--overwrite"
                raise FileExistsError(f"{path} exists; {ways}")
            refuse_folder(path, path)


@Parameter(name="*")
@dataclass(frozen=True)
class CaseOptions(OutputOptions, ReadingOptions):
    """Options of a command that reads a case and writes files."""


@Parameter(name="*")
@dataclass(frozen=True)
class LogOptions:
    """Options of a command that reads logs."""

    columns: Annotated[
        str | None,
        Parameter(
            help='Columns to read, with units, as "a1, a2 [g]"; of files without headings all, as'
            ' "time [s], a1 [g]".'
        ),
    ] = None
    rate: Annotated[float | None, Parameter(help="Sampling rate (Hz) of logs without times.")] = (
        None
    )
    missing: Annotated[
        Literal["refuse", "mask"],
        Parameter(help="Samples that are missing are refused, or left out by mask."),
    ] = "refuse"

    def read(self, path: Path) -> "Log":
        """The log in a file. Raises ValueError as `tuning.read_log` does."""
        import tuning

        return tuning.read_log(path, columns=self.columns, rate=self.rate, missing=self.missing)

    def read_runs(self, path: Path) -> "list[Log]":
        """The logs of all runs in a file. Raises ValueError as `tuning.read_logs` does."""
        import tuning

        return tuning.read_logs(path, columns=self.columns, rate=self.rate, missing=self.missing)


@Parameter(name="*")
@dataclass(frozen=True)
class DrawingOptions:
    """Options of a command that draws."""

    size: Annotated[
        str, Parameter(help="WIDTHxHEIGHT of pictures, such as 160x100mm, 16x10cm or 6x4in.")
    ] = ""
    dpi: Annotated[float, Parameter(help="Dots per inch of pictures; 150 if left out.")] = 150.0
    title: Annotated[str | None, Parameter(help="Title of pictures; '' for none.")] = None

    def check(self, *paths: Path | None) -> None:
        """Check the options and files of pictures, before any work.

        Raises UsageError for a size without a unit, too many or no dots per inch, and for a file of
        another ending than .png, .svg and .pdf.
        """
        self.inches()
        if not 10 <= self.dpi <= 2400:
            raise UsageError(f"--dpi must be from 10 to 2400; it is {self.dpi:g}")
        for path in filter(None, paths):
            check_suffix(path, PICTURES[0], "a picture", PICTURES[1:])

    def inches(self) -> tuple[float, float] | None:
        """Width and height in inches, None if left out. Raises ValueError as `check` does."""
        return parse_size(self.size) if self.size else None

    def page(self) -> Any:
        """Axes that fill a figure of the size, in whose place one is drawn; None if left out."""
        size = self.inches()
        if size is None:
            return None
        from jaxbeam.plot.style import page

        return page(size)

    def titled(self, figure: Any) -> Any:
        """The figure with the title of `--title`, if there is one."""
        if self.title is not None:
            from jaxbeam.plot.style import set_title

            figure.suptitle("")
            set_title(figure, self.title, "")
        return figure

    def save(self, figure: Any, path: Path) -> None:
        """Write a figure, also one that was drawn in the place of `page`, to a file."""
        whole = figure.get_figure(root=True)
        size = self.inches()
        if size is not None:
            whole.set_size_inches(size)
        options = PNG_OPTIONS if path.suffix.lower() == ".png" else {}
        with whole_file(path, overwrite=True) as partial:  # refused before, where it is not asked
            whole.savefig(partial, dpi=self.dpi, **options)


@Parameter(name="*")
@dataclass(frozen=True)
class PictureOptions(DrawingOptions):
    """Options of a command that draws on request."""

    plot: Annotated[
        bool,
        Parameter("--plot", help="Draw to a PNG beside the output, or named after the input."),
    ] = False
    picture: Annotated[
        Path | None, Parameter(help="Draw to this file instead, OUT.png, OUT.svg or OUT.pdf.")
    ] = None

    def path(self, output: Path | None, source: Path) -> Path | None:
        """File of the picture: that of `--picture`, or with `--plot` beside output or source.

        Raises ValueError as `check` does.
        """
        path = self.picture or (figure_path(output, source) if self.plot else None)
        self.check(path)
        return path


@Parameter(name="*")
@dataclass(frozen=True)
class LabelledPictureOptions(PictureOptions):
    """Options of a command that draws what sensors measure, on request."""

    labels: Annotated[
        str, Parameter(help="NAME,NAME,...: names of the sensors in pictures, in their order.")
    ] = ""

    def sensor_labels(self, case: "jb.Case") -> list[str] | None:
        """Names of the sensors of a case in pictures, None if left out.

        Raises UsageError for another number of names than sensors.
        """
        names = [name.strip() for name in self.labels.split(",")] if self.labels else None
        if names is not None and len(names) != len(case.sensors):
            raise UsageError(
                f"--labels names {counted(len(names), 'sensor')}; the case has {len(case.sensors)}"
            )
        return names


def print_plausibility(
    case: "jb.Case", options: PrintOptions, *others: "jb.Case"
) -> dict[str, Any]:
    """Print the line of plausibility of a case and warn of what looks wrong; the numbers for JSON.

    The warnings are also those of other cases. The line is left out with `--json`.
    """
    found, *more = map(jb.check, (case, *others))
    warnings = dict.fromkeys(itertools.chain(found.warnings, *(one.warnings for one in more)))
    found = dataclasses.replace(found, warnings=tuple(warnings))
    if not options.json_:
        print(f"plausibility: {found}", flush=True)
    print_warnings(found)
    return jb.api.content(found)


def print_warnings(found: "Plausibility") -> None:
    """Print what looks wrong in a case."""
    for warning in found.warnings:
        print_message(f"warning: {warning}")


def enable_compile_cache() -> None:
    """Cache the compiled programs of this command for later ones.

    Imports JAX (half a second), so that commands call it after their checks.
    """
    from jaxbeam.runtime.cache_folder import switch_on

    switch_on()


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    """Lines of a table, columns flush right; none if there are no rows."""
    cells = [[str(entry) for entry in row] for row in rows]
    return text_table(header, cells, ">" * len(header)) if cells else []


def print_message(message: str) -> None:
    """Print an error, a warning or a remark on standard error."""
    print(f"jaxbeam: {message}", file=sys.stderr)
