"""Commands `weigh` (weigh-in-motion) and `identify-responses` (fit in the frequency domain)."""

from pathlib import Path

from jaxbeam.cli.arguments import (
    UsageError,
    bounds_in_si,
    check_exists,
    parse_bounds,
    parse_range,
    refuse_option,
)
from jaxbeam.cli.options import CaseOptions, Free, Output


def weigh(
    case: Path,
    log: Path,
    /,
    *,
    speeds: str,
    max_loads: int = 3,
    one_way: bool = False,
    axles: str | None = None,
    calibration: Path | None = None,
    output: Output = None,
    options: CaseOptions = CaseOptions(),
) -> None:
    """Identify the loads that crossed a known beam: their number, masses, speeds, entry times.

    Parameters
    ----------
    case
        Case file, TOML, with sensors on the beam; its loads are ignored.
    log
        Log of the sensors during the crossing.
    speeds
        LOW:HIGH: range of speeds (m/s) to search.
    max_loads
        Largest number of loads to try.
    one_way
        Search loads from the left only.
    axles
        Weigh one vehicle or train of so many axles, or of as many as are found with `auto`: their
        forces and spacings.
    calibration
        Log of a vehicle of known axle loads (in the TOML file beside it), for the influence lines.
    output
        Write the case with the identified loads to this file, TOML.
    """
    options.check_outputs(output)
    speed_range = parse_range("--speeds", speeds, "m/s, such as 0.5:3")
    number = None if axles in (None, "auto") else _axle_count(axles)
    check_exists("log file", log)
    if calibration is not None:
        check_exists("log file", calibration)
        refuse_option(
            axles is None,
            "--calibration is for Moses' method: say how many --axles, or --axles auto",
        )
    options.check_case(case)

    import tuning  # sets XLA's threads, therefore before the case is read
    from jaxbeam.files.case_file import save_case

    parsed_case, read = options.read(case), tuning.read_log(log)
    if axles is None:
        weighing = tuning.weigh(parsed_case, read, speed_range, max_loads, both_ways=not one_way)
    else:
        lines = None
        if calibration is not None:
            lines = tuning.calibrate_influence_lines(parsed_case, tuning.read_log(calibration))
        weighing = tuning.weigh_axles(
            parsed_case, read, speed_range, number, both_ways=not one_way, influence_lines=lines
        )
    if output:
        save_case(weighing.fit.case, output, overwrite=True)  # checked before the work
    options.report(weighing.to_dict(), [str(weighing)], output)


def _axle_count(text: str) -> int:
    """The number of axles that an option gives. Raises ValueError if it is none."""
    if not text.isdecimal():
        raise UsageError(f"--axles takes a whole number, or auto, not {text!r}")
    return int(text)


def identify_responses(
    case: Path,
    log: Path,
    /,
    *,
    free: Free = (),
    segment: float | None = None,
    output: Output = None,
    options: CaseOptions = CaseOptions(),
) -> None:
    """Identify parameters of a case, without its loads, from frequency responses in a log.

    Parameters
    ----------
    case
        Case file, TOML.
    log
        Log of the sensors and of one command to an actuator.
    segment
        Length (s) of the averaged segments of the log; an eighth of it if left out.
    output
        Write the fitted case to this file, TOML.
    """
    options.check_outputs(output)
    refuse_option(not free, "name what to identify with --free ADDRESS")
    bounds = dict(map(parse_bounds, free))
    check_exists("log file", log)
    options.check_case(case)

    import tuning  # sets XLA's threads, therefore before the case is read
    from jaxbeam.files.case_file import save_case

    parsed_case = options.read(case)
    measured = tuning.responses_of(tuning.read_log(log), segment)
    fit = tuning.identify_responses(parsed_case, measured, bounds_in_si(parsed_case, bounds))
    if output:
        save_case(fit.case, output, overwrite=True)  # checked before the work
    options.report(fit.to_dict(), [str(fit)], output)
