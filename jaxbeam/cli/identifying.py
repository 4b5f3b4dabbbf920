"""Commands that identify numbers from logs, and show how."""

from pathlib import Path

from jaxbeam.arguments import (
    bounds_of,
    check_outputs,
    picture_path,
    read_case,
    refuse,
    split_files,
)
from jaxbeam.cli.app import Json, Output, Overwrite, Settings, app, say
from jaxbeam.printing import print_json, print_written


@app.command
def demo(
    *,
    output: Output = None,
    json_: Json = False,
) -> None:
    """Identify a rig from logged data, end to end, in under a minute.

    Parameters
    ----------
    output
        Folder for the figure and the record; a fresh one below `out` if left out.
    """
    from experiments import demo as demonstration

    demonstration.run(output, json=json_)


@app.command
def identify(
    *files: Path,
    free: tuple[str, ...] = (),
    output: Output = None,
    plot: bool = False,
    set_: Settings = (),
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Identify numbers of a case from logs; without --free, the modes seen in a free decay.

    Parameters
    ----------
    files
        [CASE.toml] LOG...: the case to fit, if any, and the logs.
    free
        ADDRESS[=LOW:HIGH]: a number to identify, between bounds; repeat it for more.
    output
        Write the fitted case to this file, FIT.toml.
    plot
        Draw measured and fitted to a PNG beside the output, or named after the log.
    """
    case, logs = split_files(files, free)
    if case and free:
        picture = picture_path(output, logs[0]) if plot else None
        check_outputs(overwrite, output, picture)
        _identify_case(read_case(case, set_), logs, free, output, picture, json_)
        return
    refuse(
        bool(output or set_),
        "-o and --set are for fitting a case; name what is free with --free ADDRESS",
    )
    if case:
        say(f"nothing is named with --free, so {case} is not used; modes of the free decay:")
    pictures = [picture_path(None, log) if plot else None for log in logs]
    check_outputs(overwrite, *pictures)
    _identify_modes(logs, pictures, json_)


def _identify_case(case, logs, free, output, picture, json_) -> None:
    import tuning
    from jaxbeam.casefile import save_case

    bounds = dict(bounds_of(text) for text in free)
    fit = tuning.identify(case, [tuning.read_log(path) for path in logs], bounds)
    if output:
        save_case(fit.case, output, overwrite=True)  # checked before the work
    if picture:
        fit.plot().savefig(picture)
    if json_:
        print_json(fit.to_dict())
    else:
        print(fit)
        print_written(output, picture)


def _identify_modes(logs, pictures, json_) -> None:
    import tuning

    found = {}
    for log, picture in zip(logs, pictures, strict=True):
        fit = found[str(log)] = tuning.identify_modes(tuning.read_log(log))
        if picture:
            fit.plot().savefig(picture)
        if not json_:
            print(f"{log}\n{fit}")
            print_written(picture)
    if json_:
        print_json({log: fit.to_dict() for log, fit in found.items()})
