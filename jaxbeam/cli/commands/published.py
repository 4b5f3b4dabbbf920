"""Commands on published problems and results: `benchmark`, `reproduce`, and the `demo`."""

from importlib import resources
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import jaxbeam as jb
from jaxbeam.case.toml_file import read_toml
from jaxbeam.cli.arguments import UsageError, refuse_option
from jaxbeam.cli.options import (
    Output,
    OutputOptions,
    PrintOptions,
    enable_compile_cache,
    print_message,
    table,
)
from jaxbeam.runtime.printer import text_table


def benchmark(
    problem: str = "",
    /,
    *,
    controller: Path | None = None,
    seed: Annotated[tuple[int, ...], Parameter(consume_multiple=True)] = (),
    options: PrintOptions = PrintOptions(),
) -> None:
    """Print frozen problems with the scores of their baselines, or score a controller.

    A score is the mean share of the attainable reduction of the peak: 0 % without control; no
    controller exceeds 100 %. Raises UsageError for an unknown problem, and options without one.

    Parameters
    ----------
    problem
        Name of a problem: print its test loads one by one; all problems if left out.
    controller
        File with a table [controller], or a case file, whose controller is scored instead.
    seed
        Seeds of test loads other than the published ones.
    """
    problems = sorted(
        file.name.removesuffix(".toml")
        for file in (resources.files("jaxbeam.benchmark") / "problems").iterdir()
        if file.name.endswith(".toml")
    )
    if problem and problem not in problems:
        raise UsageError(
            f"there is no problem {problem!r} in the benchmark; it has {', '.join(problems)}"
        )
    needs_problem = bool((controller or seed) and not problem)
    refuse_option(needs_problem, "--controller and --seed are for one problem: name it")
    if controller is not None:
        read_toml(controller)
    if any(one < 0 for one in seed):
        raise UsageError("--seed takes whole numbers from 0 on")
    enable_compile_cache()

    from jaxbeam.benchmark.problem import TEST_SEEDS, VERSION
    from jaxbeam.benchmark.scoring import attainable, published

    if problem:
        own = jb.benchmark.load(problem)
        if controller is None and not seed:
            found = jb.benchmark.baselines()[problem]
        else:
            found = jb.benchmark.score(own, controller, seed or TEST_SEEDS)
        loads = [attainable(own, one) for one in found.seeds]
        rows = [
            {
                "seed": one,
                "load": dict(zip(own.vary, load.load.tolist(), strict=True)),
                "uncontrolled": load.uncontrolled,
                "bound": load.bound,
                "peak": float(peak),
                "share": float(share),
            }
            for one, load, peak, share in zip(
                found.seeds, loads, found.peaks, found.shares, strict=True
            )
        ]
        content = {"problem": problem, "score": found.mean, "worst": found.worst, "runs": rows}
        header = ("seed", "load", "no control (m)", "bound (m)", "peak (m)", "share")
        lines = table(
            header,
            [
                (
                    row["seed"],
                    " ".join(f"{value:.4g}" for value in row["load"].values()),
                    *(f"{row[name]:.5g}" for name in ("uncontrolled", "bound", "peak")),
                    f"{row['share']:.1%}",
                )
                for row in rows
            ],
        )
        about = f"{own.case.title} ({VERSION}); load: {', '.join(own.vary)}"
        result = f"score {found.mean:.1%}, worst {found.worst:.1%}"
        options.report(content, [about, *lines, result])
        return
    scores = jb.benchmark.baselines()
    rows = []
    for name, found in scores.items():
        reductions = [1 - one.bound / one.uncontrolled for one in published(name)["test"]]
        law = jb.benchmark.load(name).case.controller
        rows.append(
            {
                "problem": name,
                "attainable_reduction": sum(reductions) / len(reductions),
                "baseline": type(law).kind,
                "score": found.mean,
                "worst": found.worst,
            }
        )
    header = ("problem", "attainable reduction", "baseline", "score", "worst")
    cells = [
        (
            row["problem"],
            f"{row['attainable_reduction']:.1%}",
            row["baseline"],
            f"{row['score']:.1%}",
            f"{row['worst']:.1%}",
        )
        for row in rows
    ]
    options.report({"version": VERSION, "problems": rows}, table(header, cells))


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
