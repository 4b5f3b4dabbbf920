"""The command that reproduces the thesis."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.cli.app import Json, Overwrite, app, print_message
from jaxbeam.cli.arguments import refuse
from jaxbeam.cli.printing import print_json, print_table

MAX_PROCESSES = 2  # experiments at once, each of which takes a core and up to 2 GB


@app.command
def reproduce(
    *names: str,
    all_: Annotated[bool, Parameter("--all")] = False,
    list_: Annotated[bool, Parameter("--list")] = False,
    output: Annotated[Path, Parameter(("-o", "--output"))] = Path("out/reproduce"),
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Reproduce the published numbers: ours beside them, with a verdict and the figures.

    Parameters
    ----------
    names
        Experiments to run; --list names them.
    all_
        Run all of them, in some minutes.
    list_
        List the experiments and what they cover.
    output
        Folder for the report and the figures; out/reproduce if left out.
    """
    from experiments.thesis import reproduction

    available = reproduction.experiments()
    if list_:
        if json_:
            print_json(
                {one.name: {"covers": one.covers, "claim": one.claim} for one in available.values()}
            )
        else:
            print_table(("name", "covers"), [(one.name, one.covers) for one in available.values()])
        return
    refuse(not (names or all_), "name an experiment, or take --all; --list names them")
    refuse(bool(names and all_), "give names or --all, not both")
    runs = reproduction.reproduce(
        tuple(available) if all_ else names,
        output,
        overwrite,
        (lambda text: None) if json_ else print,
        processes=min(MAX_PROCESSES, len(available) if all_ else len(names)),
    )
    if json_:
        print_json(reproduction.as_dict(runs))
        return
    print_message(f"written to {output}: report.html, report.md, report.json and the figures")
