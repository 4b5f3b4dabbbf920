"""Commands of the experiments: `reproduce` the thesis, `demo`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.cli.arguments import refuse_option
from jaxbeam.cli.options import (
    Output,
    OutputOptions,
    PrintOptions,
    enable_compile_cache,
    print_message,
)
from jaxbeam.runtime.printer import text_table

MAX_PROCESSES = 2  # experiments at once, each of which takes a core and up to 2 GB


def demo(*, output: Output = None, options: PrintOptions = PrintOptions()) -> None:
    """Identify a rig from logs, sweep it and tune a controller for it, in a minute or two.

    Parameters
    ----------
    output
        Folder for figures, cases and results; a new one below `out` if left out.
    """
    enable_compile_cache()
    from experiments import demo as demonstration

    demonstration.run(output, json=options.json_)


def reproduce(
    *names: str,
    all_: Annotated[bool, Parameter("--all")] = False,
    list_: Annotated[bool, Parameter("--list")] = False,
    output: Annotated[Path, Parameter(("-o", "--output"))] = Path("out/reproduce"),
    options: OutputOptions = OutputOptions(),
) -> None:
    """Reproduce published results: our numbers beside the printed ones, verdicts, figures.

    Parameters
    ----------
    names
        Experiments to run; --list names them.
    all_
        Run all experiments; takes some minutes.
    list_
        List the experiments and what they cover.
    output
        Folder for the report and the figures; out/reproduce if left out.
    """
    refuse_option(
        not (names or all_ or list_), "name an experiment, or take --all; --list names them"
    )
    refuse_option(bool(names and all_), "give names or --all, not both")
    enable_compile_cache()
    from experiments.thesis import reproduction

    available = reproduction.experiments()
    if list_:
        options.report(
            {one.name: {"covers": one.covers, "claim": one.claim} for one in available.values()},
            text_table(
                ("name", "covers"), [(one.name, one.covers) for one in available.values()], "<<"
            ),
        )
        return
    runs = reproduction.reproduce(
        tuple(available) if all_ else names,
        output,
        options.overwrite,
        (lambda text: None) if options.json_ else print,
        processes=min(MAX_PROCESSES, len(available) if all_ else len(names)),
    )
    if options.json_:
        options.report(reproduction.as_dict(runs), [])
        return
    print_message(f"written to {output}: report.html, report.md, report.json and the figures")
