"""Commands that ask logs for more than a fit in time: the loads, or responses to commands."""

from pathlib import Path

from jaxbeam.cli.app import Json, Output, Overwrite, Settings, app
from jaxbeam.cli.arguments import bounds_of, check_outputs, range_of, read_case, refuse
from jaxbeam.cli.printing import print_json, print_written


@app.command
def weigh(
    case: Path,
    log: Path,
    /,
    *,
    speeds: str,
    most: int = 3,
    one_way: bool = False,
    output: Output = None,
    set_: Settings = (),
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Weigh the loads that crossed a known beam: their number, masses, speeds and entry times.

    Parameters
    ----------
    case
        Case file, TOML, with sensors of deflection; its loads are not used.
    log
        Their readings.
    speeds
        LOW:HIGH: the speeds (m/s) that come into question.
    most
        How many loads to look for at most.
    one_way
        Look for loads from the left only.
    output
        Write the case with the loads found to this file, TOML.
    """
    import tuning
    from jaxbeam.files.case_file import save_case

    check_outputs(overwrite, output)
    speed_range = range_of("--speeds", speeds, "m/s, such as 0.5:3")
    weighing = tuning.weigh(
        read_case(case, set_), tuning.read_log(log), speed_range, most, both_ways=not one_way
    )
    if output:
        save_case(weighing.fit.case, output, overwrite=True)  # checked before the work
    if json_:
        print_json(weighing.to_dict())
    else:
        print(weighing)
        print_written(output)


@app.command
def identify_responses(
    case: Path,
    log: Path,
    /,
    *,
    free: tuple[str, ...] = (),
    segment: float | None = None,
    output: Output = None,
    set_: Settings = (),
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Identify numbers of a case from frequency responses to the command in a log, loads away.

    Parameters
    ----------
    case
        Case file, TOML.
    log
        Readings, and one command to an actuator.
    free
        ADDRESS[=LOW:HIGH]: a number to identify, between bounds; repeat it for more.
    segment
        Seconds of the log for each average; an eighth of it if left out.
    output
        Write the fitted case to this file, TOML.
    """
    import tuning
    from jaxbeam.files.case_file import save_case

    check_outputs(overwrite, output)
    refuse(not free, "name what to identify with --free ADDRESS")
    measured = tuning.responses_of(tuning.read_log(log), segment)
    fit = tuning.identify_responses(read_case(case, set_), measured, dict(map(bounds_of, free)))
    if output:
        save_case(fit.case, output, overwrite=True)  # checked before the work
    if json_:
        print_json(fit.to_dict())
    else:
        print(fit)
        print_written(output)
