"""Report of experiments: published numbers beside computed ones, as text, sections and figures."""

from collections.abc import Mapping, Sequence

import numpy as np

import jaxbeam as jb
from experiments.thesis.verdicts import (
    FITTED,
    INCONSISTENT,
    IRREPRODUCIBLE,
    NOT_COUNTED,
    REPEATED,
    VERDICTS,
    ExperimentRun,
    Finding,
    FindingVerdicts,
    reading_name,
)
from jaxbeam.files.report import ReportFigure, ReportSection, ReportTable
from jaxbeam.plot.style import colour
from jaxbeam.runtime.printer import text_table


def plot_deflections(
    axes, records: Mapping[str, jb.Record], sensor: int = 0, colours: Sequence[str] | None = None
) -> None:
    """Draw the deflection (mm) at one sensor over time (s), a labelled curve for each record.

    `colours` has one for each record; those of the style if left out.
    """
    for i, (name, record) in enumerate(records.items()):
        history = 1e3 * np.asarray(record.deflection)[:, sensor]
        line_colour = colour(i) if colours is None else colours[i]
        axes.plot(record.times, history, color=line_colour, label=name)


def plot_commands(
    axes,
    records: Mapping[str, jb.Record],
    actuators: Sequence[int] = (0,),
    gains: Sequence[float] | None = None,
    held: bool = False,
    colours: Sequence[str] | None = None,
) -> None:
    """Draw commands (V) to some actuators over time (s), in the colour of each record.

    Records without a controller are left out; the second command is dashed. `gains` has a factor
    for each command. `held` draws steps, for commands that are held between samples.
    """
    drawstyle = "steps-post" if held else "default"
    for i, record in enumerate(records.values()):
        if record.case.controller is None:
            continue
        line_colour = colour(i) if colours is None else colours[i]
        commands = np.asarray(record.command)[:, list(actuators)]
        if gains is not None:
            commands = commands * np.asarray(gains)
        for command, dashes in zip(commands.T, ("-", "--"), strict=False):
            axes.plot(record.times, command, dashes, color=line_colour, drawstyle=drawstyle)


TITLE = "The thesis, reproduced"
ALL_VERDICTS = (*VERDICTS, *NOT_COUNTED)
COLUMNS = ("number", "published", "computed", "null model", "tolerance", "verdict")
METHOD = (
    "The thesis's figures and measured curves are not available: comparisons are with printed"
    " numbers, and figures have the thesis's axes. A tolerance is a unit of the last printed digit,"
    " with the rounding of the printed parameters, or twice the noise of the sensors that section"
    " 5.1 prints. One reading serves for all numbers of a rig in a chapter, the likeliest by its"
    " misfit: squared differences over half the tolerance, cut off at three tolerances, and two for"
    " each fitted parameter. A number that a null model meets as well, or that cannot tell the two"
    " apart, that a parameter was fitted to, or that repeats another, and a yes or a no, count for"
    ' nothing. No proof, no "cannot be right".'
)
VERDICT_STYLE = (
    ".reproduced { color: #00694c } .explained { color: #0072b2 } .not, .cannot { color: #b34700 }"
    " .met, .fitted, .repeats, .a { color: #777777 }"
)


def as_text(run: ExperimentRun) -> str:
    """One experiment for the terminal."""
    lines = [f"{run.experiment.name}: {run.experiment.covers}", f"  {run.experiment.claim}"]
    for finding, assigned in zip(run.outcome.findings, run.verdicts, strict=True):
        lines += ["", f"  {_finding_title(finding)}"]
        lines += text_table(COLUMNS, _finding_rows(finding, assigned), indent="    ")
        lines += [f"    {sentence}" for sentence in _finding_notes(finding, assigned)]
    lines += [f"  {remark}" for remark in run.outcome.remarks]
    counts = [f"{run.count(word)} {word}" for word in ALL_VERDICTS if run.count(word)]
    summary = ", ".join(counts) or "nothing printed to compare with"
    return "\n".join([*lines, "", f"  {summary}; {run.seconds:.0f} s", ""])


def sections(runs: Sequence[ExperimentRun]) -> list[ReportSection]:
    """The report of all experiments: method and summary, then each finding with its numbers."""
    report = [ReportSection("", [METHOD, _summary_table(runs)])]
    for run in runs:
        title = f"{run.experiment.name}: {run.experiment.covers}"
        report.append(ReportSection(title, [run.experiment.claim]))
        for finding, assigned in zip(run.outcome.findings, run.verdicts, strict=True):
            table = ReportTable(COLUMNS, _finding_rows(finding, assigned), _verdict_class)
            notes = _finding_notes(finding, assigned)
            report.append(ReportSection(_finding_title(finding), [table, *notes], level=3))
        figures = [ReportFigure(figure_name(run, name)) for name in run.outcome.figures]
        report.append(ReportSection("", [*run.outcome.remarks, *figures]))
    return report


def figure_name(run: ExperimentRun, name: str) -> str:
    """Name of the file of a figure, without its suffix."""
    return f"{run.experiment.name}-{name}"


def _finding_title(finding: Finding) -> str:
    published = finding.published
    unit = "" if published.unit in ("", "1") else f", {published.unit}"
    return f"{published.location}: {published.quantity}{unit} ({published.origin})"


def _finding_rows(finding: Finding, assigned: FindingVerdicts) -> list[tuple[str, ...]]:
    """One row for each number; the computed one is by the likeliest interpretation."""
    published = finding.published
    columns = (
        published.value_labels,
        published.printed_text.split(),
        finding.values(assigned.reading),
        finding.null.values,
        published.allowed_error,
        assigned.verdicts,
    )
    return [
        (
            label.replace(",", ", "),
            printed,
            _number(value),
            _number(null),
            f"{allowed:.3g}",
            verdict,
        )
        for label, printed, value, null, allowed, verdict in zip(*columns, strict=True)
    ]


def _number(value: float) -> str:
    return "\N{EM DASH}" if np.isnan(value) else f"{value:.6g}"


def _finding_notes(finding: Finding, assigned: FindingVerdicts) -> list[str]:
    """Sentences on the null model, on each reading and its misfit, and on what is not met."""
    published, verdicts = finding.published, assigned.verdicts
    misfits = assigned.misfits
    sentences = [f"Tolerance: {published.tolerance.basis}. Null model: {finding.null.name}."]
    if published.interpretation:
        sentences.append(f"Interpretation: {published.interpretation}.")
    if len(finding.readings) > 1:
        for reading, values in finding.readings.items():
            numbers = " ".join(_number(value) for value in values)
            taken = ", taken" if reading == assigned.reading & finding.answers else ""
            hits = int(finding.within_tolerance(reading).sum())
            least = f"{misfits[reading]:.3g}" if reading in misfits else "\N{EM DASH}"
            sentences.append(
                f"{reading_name(reading)}: {numbers} ({hits} of {len(verdicts)} within the"
                f" tolerance; misfit of the rig {least}{taken})"
            )
        sentences.append(f"Misfit of the null model: {misfits[None]:.3g}.")
    sentences.append(f"Reading of {published.rig}: {reading_name(assigned.reading)}.")
    if FITTED in verdicts:
        sentences.append("Parameters of the reading were fitted to it.")
    if REPEATED in verdicts:
        sentences.append(f"Repeats {published.repeats}.")
    if IRREPRODUCIBLE in verdicts:
        sentences.append(f"Cannot be right because {'; '.join(finding.impossible.values())}.")
    if INCONSISTENT in verdicts:
        sentences.append(f"Cannot all be right because {finding.inconsistent}.")
    if finding.remark:
        sentences.append(f"{finding.remark[0].upper()}{finding.remark[1:]}.")
    return sentences


def _summary_table(runs: Sequence[ExperimentRun]) -> ReportTable:
    """Count of numbers by verdict, and wall time, for each experiment and for all."""

    def row(name: str, runs: Sequence[ExperimentRun]) -> tuple[str, ...]:
        counts = [sum(run.count(word) for run in runs) for word in ALL_VERDICTS]
        seconds = sum(run.seconds for run in runs)
        return (name, str(sum(counts)), *map(str, counts), f"{seconds:.0f}")

    rows = [row(run.experiment.name, [run]) for run in runs]
    header = ("experiment", "numbers", *ALL_VERDICTS, "seconds")
    return ReportTable(header, [*rows, row("all", runs)], _verdict_class)


def _verdict_class(cell: str) -> str | None:
    """CSS class of a cell with a verdict."""
    return cell.split()[0] if cell in ALL_VERDICTS else None
