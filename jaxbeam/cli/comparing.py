"""The command that compares controllers."""

import itertools
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.case.validation import check
from jaxbeam.cli.app import Json, Output, Overwrite, Settings, app
from jaxbeam.cli.arguments import (
    check_outputs,
    check_suffix,
    read_case,
    read_controllers,
    refuse,
    sweep_values,
)
from jaxbeam.cli.printing import print_json, print_table, print_written


@app.command
def compare(
    case: Path,
    /,
    *,
    controllers: Annotated[tuple[Path, ...], Parameter(consume_multiple=True)] = (),
    over: tuple[str, ...] = (),
    period: float | None = None,
    output: Output = None,
    set_: Settings = (),
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Compare controllers on a case, beside the least peak that any controller could achieve.

    Parameters
    ----------
    case
        Case file, TOML; its own controller, if it has one, takes part.
    controllers
        More controllers: files with a table [controller], or case files of which only that is
        used. They are called after their files.
    over
        ADDRESS=START:STOP:COUNT or ADDRESS=V1,V2,...: compare on every combination of these values,
        and over all of them; repeat it for more numbers.
    period
        The least peak is for commands held this long (s); the shortest period of the
        controllers, or 0.01, if left out.
    output
        Draw deflections and commands to this file, OUT.png.
    """
    import jaxbeam as jb
    from jaxbeam.analysis.compare import compare, metrics_over_cases

    values = sweep_values(over)
    check_suffix(output, ".png", "a comparison")
    refuse(bool(output and over), "a picture shows one load case: leave out -o or --over")
    check_outputs(overwrite, output)
    parsed_case = read_case(case, set_)
    laws = read_controllers(case, parsed_case, controllers)
    runs = [dict(zip(values, row, strict=True)) for row in itertools.product(*values.values())]
    cases_compared = [jb.replace(parsed_case, run) for run in runs]
    for one in cases_compared:
        check(one)
    comparisons = [compare(one, laws, period) for one in cases_compared]
    table = metrics_over_cases(comparisons)
    if output:
        from jaxbeam.plot import plot_comparison

        plot_comparison(comparisons[0]).savefig(output)
    if json_:
        cases = [
            {"values": run} | _comparison_dict(one)
            for run, one in zip(runs, comparisons, strict=True)
        ]
        summary = {name: standing._asdict() for name, standing in table.items()}
        print_json(
            {"cases": cases, "over_all": summary} if over else _comparison_dict(comparisons[0])
        )
        return
    for run, one in zip(runs, comparisons, strict=True):
        if over:
            print("; ".join(f"{address} = {value:g}" for address, value in run.items()))
        _print_comparison(one)
    if over:
        print(f"over all {len(comparisons)} load cases:")
        print_table(
            (
                "controller",
                "largest peak (m)",
                "worst share of the bound",
                "mean share",
                "largest after exit (m)",
                "most saturated",
            ),
            [
                (
                    name,
                    f"{one.peak:.6g}",
                    f"{one.worst_share:.1%}",
                    f"{one.mean_share:.1%}",
                    f"{one.after_exit:.4g}",
                    f"{one.saturated:.1%}",
                )
                for name, one in table.items()
            ],
        )
    print_written(output)


def _comparison_dict(comparison) -> dict:
    """A comparison in words and numbers."""
    bound = comparison.bound
    return {
        "uncontrolled_peak": bound.uncontrolled,
        "least_peak": bound.peak,
        "held_for": bound.period,
        "controllers": {
            name: metrics._asdict()
            | {
                "step_times": metrics.step_times._asdict(),
                "reserve": metrics.reserve._asdict()
                | {"unstable": metrics.reserve.unstable and metrics.reserve.unstable._asdict()},
                "swings": [one._asdict() for one in metrics.swings],
                "loop": comparison.loop(name),
                "verdict": comparison.records[name].verdict,
            }
            for name, metrics in comparison.merits.items()
        },
    }


def _print_comparison(comparison) -> None:
    """Print a comparison for people."""
    bound = comparison.bound
    print(
        f"no control: peak {bound.uncontrolled:.6g} m; no controller that holds its commands for "
        f"{bound.period:g} s gets below {bound.peak:.6g} m, {bound.reduction:.1%} less"
    )
    print_table(
        (
            "controller",
            "peak (m)",
            "share of the bound",
            "RMS (m)",
            "after exit (m)",
            "effort (command^2 s)",
            "saturated",
            "gain margin",
            "delay margin (s)",
            "time per step (s)",
            "worst",
            "batched",
        ),
        [
            (
                name,
                f"{merits.peak:.6g}",
                f"{merits.share:.1%}",
                f"{merits.rms:.4g}",
                f"{merits.after_exit:.4g}",
                " ".join(f"{effort:.4g}" for effort in merits.effort),
                " ".join(f"{share:.1%}" for share in merits.saturated),
                *(_margin_text(merits.reserve, number) for number in merits.reserve[:2]),
                *(f"{seconds:.2g}" for seconds in merits.step_times[:3]),
            )
            for name, merits in comparison.merits.items()
        ],
    )
    margin_errors = {name: metrics.reserve.obstacle for name, metrics in comparison.merits.items()}
    for obstacle in dict.fromkeys(filter(None, margin_errors.values())):
        names = [name for name, met in margin_errors.items() if met == obstacle]
        print(f"no margin of {', '.join(names)}: {obstacle}")
    for name, record in comparison.records.items():
        print(f"{name}: {'; '.join(filter(None, (comparison.loop(name), record.verdict)))}")


def _margin_text(margin, number: float) -> str:
    if margin.obstacle:
        return "-"
    return "unstable" if margin.gain == 0 else f"{number:.3g}"
