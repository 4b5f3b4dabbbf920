"""Command `monitor`: modes of a structure over time, from a folder of logs."""

import os
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.cli.arguments import figure_path, parse_range, refuse_option
from jaxbeam.cli.options import Output, OutputOptions
from jaxbeam.files.endings import TABLES, check_ending


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
