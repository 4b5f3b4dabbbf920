"""Commands `weigh` (weigh-in-motion) and `identify-responses` (fit in the frequency domain).

`weigh calibrate` finds influence lines, `weigh traffic` a table of vehicles over a day.
"""

import json
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.cli.arguments import (
    UsageError,
    bounds_in_si,
    check_exists,
    parse_bounds,
    parse_range,
    refuse_option,
)
from jaxbeam.cli.options import CaseOptions, Free, LogOptions, Output
from jaxbeam.runtime.output_file import TABLES, check_ending


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
    """Identify the loads that crossed the beam of a case: number, masses, speeds, entry times.

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


def traffic(
    case: Path,
    /,
    *logs: Path,
    speeds: str,
    calibration: tuple[Path, ...] = (),
    detectors: str | None = None,
    one_way: bool = False,
    least_weight: float = 35.0,
    store: Annotated[Path | None, Parameter(show_default=False)] = None,
    output: Output = None,
    reading: LogOptions = LogOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Weigh all vehicles in long logs, or a folder of logs: a table with a row for each.

    Vehicles may come one by one, close behind each other, or meet on the bridge. Each is weighed
    once, also after an interruption: the next call goes on where this one ended.

    Parameters
    ----------
    case
        Case file, TOML, with sensors on the beam; its loads are ignored.
    logs
        LOG...: logs of the sensors, or folders of logs.
    speeds
        LOW:HIGH: range of speeds (m/s) of the vehicles.
    calibration
        Logs of known vehicles, or a file of lines, as of weigh.
    detectors
        NAME=POSITION,NAME=POSITION: two channels with a pulse for each axle, and where they are
        (m): they tell number, distances and speed of the axles.
    one_way
        Search vehicles from the left only.
    least_weight
        Lightest vehicle to weigh (kN).
    store
        FILE.jsonl: vehicles so far; CASE.vehicles.jsonl beside the call by default.
    output
        FILE.csv, .xlsx, .mat or .parquet: write a table with a row for each vehicle.
    """
    refuse_option(not logs, "weigh traffic needs a log: jaxbeam weigh traffic CASE LOG...")
    if output is not None:
        check_ending(output, "a table", TABLES)
    options.check_outputs(output)
    speed_range = parse_range("--speeds", speeds, "m/s, such as 8:35")
    places = _places(detectors)
    check_exists("log file", *calibration, *logs)
    options.check_case(case)

    import tuning  # sets XLA's threads, therefore before the case is read
    from jaxbeam.files.tables import write_table
    from tuning.monitoring.history import logs_in

    place = store or Path(f"{case.stem}.vehicles.jsonl")
    settings = tuning.weighing.TrafficSettings(speed_range, not one_way, 1e3 * least_weight, places)
    parsed_case = options.read(case)
    lines = _lines_of(parsed_case, calibration, reading) if calibration else None
    files = [
        file for path in logs for file in (logs_in(path, "*", place) if path.is_dir() else [path])
    ]
    found = tuning.weighing.weigh_logs(
        parsed_case, files, place, settings, lines,
        columns=reading.columns, rate=reading.rate, missing=reading.missing,
        progress=not options.json_,
    )  # fmt: skip
    if output is not None:
        write_table(output, found.columns, options.overwrite)
    options.report(found.to_dict(), [str(found)], output, place)


def _places(text: str | None) -> dict[str, float]:
    """Positions (m) of detectors by their channels. Raises UsageError for other words."""
    found = {}
    for part in text.split(",") if text else ():
        name, _, place = part.partition("=")
        try:
            found[name.strip()] = float(place)
        except ValueError:
            raise UsageError(
                f"--detectors takes NAME=POSITION,NAME=POSITION in m, not {part!r}"
            ) from None
    return found


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
