"""Commands on modes of logs: `modes-from-log`, and `monitor` for a folder of them."""

import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import jaxbeam as jb
from jaxbeam.cli.arguments import (
    UsageError,
    bounds_in_si,
    check_exists,
    figure_path,
    parse_bounds,
    parse_range,
    refuse_option,
)
from jaxbeam.cli.options import CaseOptions, Free, LogOptions, Output, OutputOptions, print_message
from jaxbeam.runtime.output_file import TABLES, check_ending

if TYPE_CHECKING:
    from tuning import Log


def modes_from_log(
    *logs: Path,
    band: str | None = None,
    from_: Annotated[float | None, Parameter("--from")] = None,
    to: float | None = None,
    channels: str | None = None,
    order: int | None = None,
    method: str | None = None,
    references: str | None = None,
    force: str | None = None,
    force_window: float | None = None,
    responses: str | None = None,
    exponential: float | None = None,
    kind: str | None = None,
    exclude: str | None = None,
    choose: str | None = None,
    count: int | None = None,
    align: bool = False,
    as_logged: bool = False,
    plot: bool = False,
    html: bool = False,
    length: float | None = None,
    case: Path | None = None,
    free: Free = (),
    output: Output = None,
    reading: LogOptions = LogOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Natural frequencies, damping ratios and mode shapes from logs of unknown excitation.

    Free decays after impacts, ambient vibration, and the harmonic lines of machines in it are
    recognised. Every choice is printed with the option that overrides it. Logs whose sensors are at
    other places are setups, whose modes are merged. With `--case`, parameters of a case are fitted
    to the modes that were found, with 95 % intervals.

    Parameters
    ----------
    logs
        LOG...: logs of the same channels are used together; the modes of logs with other channels
        (setups), of which some are the same (references), are merged.
    band
        LOW:HIGH: frequencies (Hz) between which modes are sought.
    from_
        Start (s) of the part of the log to use.
    to
        End (s) of the part of the log to use.
    channels
        NAME,NAME,...: channels to use.
    order
        Highest order of the models of the stabilisation diagram.
    method
        decay: poles of free decays; for all else covariance or data: stochastic subspace
        identification, covariance- or data-driven; plscf, for measured forces: poly-reference
        least-squares complex frequency (p-LSCF).
    references
        NAME,NAME,...: channels that stay at their places in all logs, while sensors of the same
        names move; by default channels of one name are one place, if positions do not differ.
    force
        NAME,NAME,...: channels of measured forces (N), of a hammer or shaker; by default all in N.
        The responses to them are fitted by p-LSCF.
    force_window
        Time (s) after each impact from which on the force is taken for zero.
    responses
        H1, H2 or Hv: draw frequency responses to the forces, by this estimate, with their coherence
        to a PNG named after the first log.
    exponential
        Time constant (s) of an exponential window from each impact on, for `--responses`. Modes are
        found without it.
    kind
        ambient or "free decay".
    exclude
        FREQUENCY,FREQUENCY,...: frequencies (Hz) of machines or hum, which are no modes.
    choose
        FREQUENCY,FREQUENCY,...: keep the modes nearest to these frequencies (Hz), also those that
        are not well identified, and no others.
    count
        Number of modes to keep, those with most energy.
    align
        The logs are of one experiment by loggers whose clocks differ: align them by correlation.
    as_logged
        Take all samples as they are logged: readings that a logger repeats are not decimated, zeros
        before a sensor has answered not interpolated.
    plot
        Draw the log, its spectrum with the stabilisation diagram, and the shapes to a PNG named
        after the first log; of setups LOG_setup1.png and so on, and merged LOG_setups.png.
    html
        Write the stabilisation diagram of each setup, in which modes are chosen by clicks, to a
        page LOG.html for any browser.
    length
        Length (m) of the beam on which the shapes are drawn.
    case
        CASE.toml: the case whose parameters (`--free`) are fitted to the modes.
    output
        Write the fitted case to this file, FIT.toml.
    """
    refuse_option(not logs, "modes-from-log needs a log: jaxbeam modes-from-log LOG...")
    limits = None if band is None else parse_range("--band", band, "Hz, such as 5:45")
    refuse_option(
        from_ is not None and to is not None and from_ >= to, "--from must be less than --to"
    )
    refuse_option(
        (case is None) != (not free), "--case and --free belong together: what is fitted, and where"
    )
    refuse_option(output is not None and case is None, "-o writes the fitted case: give --case")
    bounds = dict(parse_bounds(text) for text in free)
    refuse_option(
        responses not in (None, "H1", "H2", "Hv"),
        f"--responses takes H1, H2 or Hv, not {responses!r}",
    )
    refuse_option(
        exponential is not None and responses is None,
        "--exponential is for --responses; modes are found without it",
    )
    excluded, chosen = _numbers("--exclude", exclude), _numbers("--choose", choose)
    check_exists("log file", *logs)
    options.check_outputs(output)
    if case is not None:
        options.check_case(case)

    import tuning
    from tuning.modal.setups import logs_of_setups

    read = list(map(reading.read, logs))
    if align:
        read = [tuning.logs.align_logs(read)]
    setups = logs_of_setups(read, _names(references), _names(channels))
    several = [f"_setup{k + 1}" for k in range(len(setups))] if len(setups) > 1 else [""]
    pictures = [_picture(logs[0], word) for word in several if plot]
    if plot and len(setups) > 1:
        pictures.append(_picture(logs[0], "_setups"))
    drawn = [_picture(logs[0], f"{word}_responses") for word in several if responses]
    pages = [_picture(logs[0], word).with_suffix(".html") for word in several if html]
    options.check_outputs(*pictures, *drawn, *pages)
    fits = []
    for setup in setups:
        window = _window(setup[0], from_, to)
        own = _of_setup(_names(channels), setup, read)
        forces = _of_setup(_names(force), setup, read)
        fit = tuning.identify_modes(
            setup,
            window=window,
            band=limits,
            kind=kind,
            method=method,
            channels=own,
            settings=tuning.ModalSettings(
                count=count,
                exclude=excluded,
                choose=chosen,
                order=order,
                force=forces,
                force_window=force_window,
                as_logged=as_logged,
            ),
            progress=None if options.json_ or not sys.stderr.isatty() else print_message,
        )
        if responses:
            tuning.modal.measured_responses(
                setup,
                forces,
                window=window,
                channels=own,
                estimator=responses,
                exponential=exponential,
                force_window=force_window,
            ).plot(drawn[len(fits)])
        fits.append(fit)
    found, lines = fits[0], [str(fit) for fit in fits]
    if len(fits) > 1:
        found = tuning.modal.merge_setups(fits, references=_names(references))
        lines += ["", str(found)]
    for fit, picture in zip(dict.fromkeys([*fits, found]), pictures, strict=False):
        fit.plot(picture, length=length)
    for fit, page in zip(fits, pages, strict=False):
        fit.to_html(page, options.overwrite)
    answer = found.to_dict()
    if case is not None:
        model = options.read(case)
        updated = tuning.identify_from_modes(model, found, bounds_in_si(model, bounds))
        answer, lines = {**answer, "fit": updated.to_dict()}, [*lines, "", str(updated)]
        if output is not None:
            jb.save_case(updated.case, output, options.overwrite)
    options.report(answer, lines, output, *pictures, *drawn, *pages)


def _picture(log: Path, word: str) -> Path:
    """Path of a picture in this folder, named after a log and a word."""
    return figure_path(None, log.with_stem(f"{log.stem}{word}"))


def _window(log: "Log", from_: float | None, to: float | None):
    """Part (s) of a log between two times, either of which may be left out; None for all.

    Raises ValueError if the log has no such part.
    """
    if from_ is None and to is None:
        return None
    first, last = (float(log.times[i]) for i in (0, -1))
    start, end = first if from_ is None else from_, last if to is None else to
    if start >= last or end <= first:
        raise ValueError(
            f"the log is from {first:g} to {last:g} s, and has no part from {start:g} to {end:g} s:"
            " change --from or --to"
        )
    return max(start, first), min(end, last)


def _of_setup(names: list[str] | None, setup: "list[Log]", read: "list[Log]"):
    """Names, among those of some channels, that the logs of a setup have.

    All names, for one clear error, if no log has one of them, or this setup has none.
    """
    if names is None or any(all(name not in log.names for log in read) for name in names):
        return names
    return [name for name in names if any(name in log.names for log in setup)] or names


def _names(text: str | None) -> list[str] | None:
    """Names separated by commas."""
    return None if text is None else [name.strip() for name in text.split(",")]


def _numbers(option: str, text: str | None) -> tuple[float, ...]:
    """Positive numbers separated by commas. Raises ValueError otherwise."""
    try:
        numbers = tuple(float(word) for word in text.split(",")) if text else ()
    except ValueError:
        numbers = (math.nan,)
    if not all(0 < number < math.inf for number in numbers):
        raise UsageError(f"{option} takes frequencies in Hz, such as 50 or 50,100, not {text!r}")
    return numbers


def monitor(
    folder: Path,
    /,
    *,
    conditions: Path | None = None,
    baseline: int = 50,
    pattern: str = "*",
    band: str | None = None,
    method: str | None = None,
    channels: str | None = None,
    columns: str | None = None,
    rate: float | None = None,
    order: int | None = None,
    processes: int | None = None,
    store: Annotated[Path | None, Parameter(show_default=False)] = None,
    plot: bool = False,
    output: Output = None,
    options: OutputOptions = OutputOptions(),
) -> None:
    """Follow the modes of a structure through a folder of logs, and tell when they change.

    Each log is analysed once, also after an interruption: its modes are kept in a file, and only
    new logs are analysed by the next call. Modes are followed by frequency and shape; of the first
    logs (the baseline) frequencies are regressed on temperatures and other conditions, and a
    control chart of the residuals raises the alarms. Raises FileNotFoundError without the folder.

    Parameters
    ----------
    folder
        FOLDER: the logs, in the order of their dates, or of their names.
    conditions
        FILE.csv: a table with the name of a log and, in further columns, conditions as its
        temperature. Columns of logs that are no vibrations are conditions, too.
    baseline
        Number of the first logs, of an unchanged structure.
    pattern
        Logs of the folder to take, as "bridge_*.csv".
    band
        LOW:HIGH: frequencies (Hz) between which modes are sought.
    method
        decay, covariance, data or plscf, as of modes-from-log.
    channels
        NAME,NAME,...: channels to use.
    columns
        Headings of the columns, with units, for files without: "time [s], a1 [g]".
    rate
        Sampling rate (Hz) of logs without times.
    order
        Highest order of the models of the stabilisation diagram.
    processes
        Number of logs that are analysed at once; by default the number of processor cores.
    store
        FILE.json: modes of the logs so far; FOLDER.modes.json beside the call by default.
    plot
        Draw the modes over time and the control chart to a PNG.
    output
        FILE.csv, .xlsx, .mat or .parquet: write a table with a row for each log.
    """
    limits = None if band is None else parse_range("--band", band, "Hz, such as 0.5:20")
    refuse_option(baseline < 2, "--baseline must be 2 logs at least")
    refuse_option(processes is not None and processes < 1, "--processes must be 1 at least")
    if output is not None:
        check_ending(output, "a table", TABLES)
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}")
    name = folder.resolve().name
    place = store or Path(f"{name}.modes.json")
    picture = figure_path(output, Path(f"{name}.png")) if plot else None
    options.check_outputs(output, picture)

    from jaxbeam.files.tables import write_table
    from tuning import monitoring

    settings = monitoring.AnalysisSettings(
        pattern=pattern,
        band=limits,
        method=method,
        channels=None if channels is None else [one.strip() for one in channels.split(",")],
        columns=columns,
        rate=rate,
        order=order,
    )
    found = monitoring.monitor(
        folder,
        place,
        settings,
        conditions=conditions,
        baseline=baseline,
        processes=processes or os.cpu_count() or 1,
        progress=not options.json_,
    )
    if output is not None:
        write_table(output, found.columns, options.overwrite)
    if picture is not None:
        found.plot(picture)
    options.report(found.to_dict(), [str(found)], output, picture, place)
