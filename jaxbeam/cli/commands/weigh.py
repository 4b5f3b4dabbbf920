"""Commands `weigh` (weigh-in-motion) and `identify-responses` (fit in the frequency domain)."""

import json
from pathlib import Path

from jaxbeam.cli.arguments import (
    UsageError,
    bounds_in_si,
    check_exists,
    parse_bounds,
    parse_range,
    refuse_option,
)
from jaxbeam.cli.options import CaseOptions, Free, LogOptions, Output


def weigh(
    case: Path,
    log: Path,
    /,
    *,
    speeds: str,
    max_loads: int = 3,
    one_way: bool = False,
    axles: str | None = None,
    calibration: tuple[Path, ...] = (),
    output: Output = None,
    reading: LogOptions = LogOptions(),
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
        Log of a vehicle of known axle loads (in the TOML file beside it), from which influence
        lines are found; repeat it for more runs. Or one JSON file of lines that `jaxbeam weigh
        calibrate` wrote.
    output
        Write the case with the identified loads to this file, TOML.
    """
    options.check_outputs(output)
    saved = [path for path in calibration if path.suffix == ".json"]
    refuse_option(bool(saved) and len(calibration) > 1, "--calibration takes one file of lines")
    speed_range = parse_range("--speeds", speeds, "m/s, such as 0.5:3")
    number = None if axles in (None, "auto") else _axle_count(axles)
    check_exists("log file", log)
    for path in calibration:
        check_exists("log file", path)
    refuse_option(
        bool(calibration) and axles is None,
        "--calibration is for axles: say how many --axles, or --axles auto",
    )
    options.check_case(case)

    import tuning  # sets XLA's threads, therefore before the case is read
    from jaxbeam.files.case_file import save_case

    parsed_case, read = options.read(case), reading.read(log)
    if axles is None:
        weighing = tuning.weigh(parsed_case, read, speed_range, max_loads, both_ways=not one_way)
    else:
        calibrated = _lines_of(parsed_case, calibration, reading) if calibration else None
        weighing = tuning.weighing.weigh_axles(
            parsed_case, read, speed_range, number, both_ways=not one_way,
            influence_lines=calibrated,
        )  # fmt: skip
    if output:
        save_case(weighing.case, output, overwrite=True)  # checked before the work
    options.report(weighing.to_dict(), [str(weighing)], output)


def calibrate(
    case: Path,
    /,
    *logs: Path,
    output: Output = None,
    reading: LogOptions = LogOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Find the influence lines of a bridge, with their errors, by runs of known vehicles.

    Parameters
    ----------
    case
        Case file, TOML, with sensors on the beam.
    logs
        LOG...: logs of vehicles of known axle loads (in the TOML files beside them), best at three
        speeds or more; runs on another lane are calibrated by themselves.
    output
        Write the lines to this file, JSON, for `jaxbeam weigh --calibration`.
    """
    refuse_option(not logs, "weigh calibrate needs a log: jaxbeam weigh calibrate CASE LOG...")
    options.check_outputs(output)
    check_exists("log file", *logs)
    options.check_case(case)

    import tuning  # noqa: F401  (sets XLA's threads, therefore before the case is read)
    from jaxbeam.runtime.output_file import whole_file

    lines = _lines_of(options.read(case), logs, reading)
    if output:
        with whole_file(output, options.overwrite) as partial:
            partial.write_text(json.dumps(lines.to_dict()))
    options.report(lines.to_dict(), [str(lines)], output)


def _lines_of(case, calibration: tuple[Path, ...], reading: LogOptions):
    """Influence lines from logs of known vehicles, or from a file of lines."""
    import tuning
    from jaxbeam.runtime.input_file import read_text_input
    from tuning.weighing.influence_lines import lines_from_dict

    if calibration[0].suffix == ".json":
        try:
            content = json.loads(read_text_input(calibration[0], "file of lines"))
        except json.JSONDecodeError as error:
            raise ValueError(f"{calibration[0]} is not JSON: {error}") from error
        return lines_from_dict(content)
    return tuning.weighing.calibrate_influence_lines(case, list(map(reading.read, calibration)))


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
    reading: LogOptions = LogOptions(),
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
    measured = tuning.fit.responses_of(reading.read(log), segment)
    fit = tuning.identify_responses(parsed_case, measured, bounds_in_si(parsed_case, bounds))
    if output:
        save_case(fit.case, output, overwrite=True)  # checked before the work
    options.report(fit.to_dict(), [str(fit)], output)
