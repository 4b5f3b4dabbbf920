"""Command `modes-from-log`: modes of a structure from measured vibrations."""

import math
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.cli.arguments import check_exists, figure_path, parse_range, refuse_option
from jaxbeam.cli.options import OutputOptions, print_message


def modes_from_log(
    *logs: Path,
    band: str | None = None,
    from_: Annotated[float | None, Parameter("--from")] = None,
    to: float | None = None,
    channels: str | None = None,
    columns: str | None = None,
    rate: float | None = None,
    order: int | None = None,
    method: str | None = None,
    kind: str | None = None,
    exclude: str | None = None,
    count: int | None = None,
    align: bool = False,
    plot: bool = False,
    length: float | None = None,
    options: OutputOptions = OutputOptions(),
) -> None:
    """Natural frequencies, damping ratios and mode shapes from logs of unknown excitation.

    Free decays after blows, ambient vibration, and the harmonic lines of machines in it are
    recognised. Every choice is printed with the option that overrides it.

    Parameters
    ----------
    logs
        LOG...: logs of the same channels, which are used together.
    band
        LOW:HIGH: frequencies (Hz) between which modes are sought.
    from_
        Start (s) of the part of the log to use.
    to
        End (s) of the part of the log to use.
    channels
        NAME,NAME,...: channels to use.
    columns
        Headings of the columns, with units, for files without: "time [s], a1 [g]".
    rate
        Sampling rate (Hz) of logs without times.
    order
        Highest order of the models of the stabilisation diagram.
    method
        covariance or data: stochastic subspace identification, covariance- or data-driven.
    kind
        ambient or "free decay".
    exclude
        FREQUENCY,FREQUENCY,...: frequencies (Hz) of machines or hum, which are no modes.
    count
        Number of modes to keep, those with most energy.
    align
        The logs are of one experiment by loggers whose clocks differ: align them by correlation.
    plot
        Draw the log, its spectrum with the stabilisation diagram, and the shapes to a PNG named
        after the first log.
    length
        Length (m) of the beam on which the shapes are drawn.
    """
    refuse_option(not logs, "modes-from-log needs a log: jaxbeam modes-from-log LOG...")
    limits = None if band is None else parse_range("--band", band, "Hz, such as 5:45")
    refuse_option(
        from_ is not None and to is not None and from_ >= to, "--from must be less than --to"
    )
    excluded = _numbers("--exclude", exclude)
    check_exists("log file", *logs)
    picture = figure_path(None, logs[0]) if plot else None
    options.check_outputs(picture)

    import tuning

    read = [tuning.read_log(path, columns=columns, rate=rate) for path in logs]
    if align:
        read = [tuning.align_logs(read)]
    window = None
    if from_ is not None or to is not None:
        first, last = (float(read[0].times[i]) for i in (0, -1))
        window = (
            first if from_ is None else max(from_, first),
            last if to is None else min(to, last),
        )
    fit = tuning.identify_modes(
        read,
        window=window,
        band=limits,
        count=count,
        kind=kind,
        channels=None if channels is None else [name.strip() for name in channels.split(",")],
        order=order,
        method=method,
        exclude=excluded,
        progress=None if options.json_ or not sys.stderr.isatty() else print_message,
    )
    if picture:
        fit.plot(picture, length=length)
    options.report(fit.to_dict(), [str(fit)], picture)


def _numbers(option: str, text: str | None) -> tuple[float, ...]:
    """Positive numbers separated by commas. Raises ValueError otherwise."""
    try:
        numbers = tuple(float(word) for word in text.split(",")) if text else ()
    except ValueError:
        numbers = (math.nan,)
    if not all(0 < number < math.inf for number in numbers):
        raise ValueError(f"{option} takes frequencies in Hz, such as 50 or 50,100, not {text!r}")
    return numbers
