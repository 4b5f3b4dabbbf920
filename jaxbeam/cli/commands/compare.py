"""Command `compare`: controllers on a case, and the least achievable peak."""

import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import jaxbeam as jb
from jaxbeam.case.toml_file import read_toml
from jaxbeam.cli.arguments import check_exists, parse_sweep_values, refuse_option
from jaxbeam.cli.options import CaseOptions, DrawingOptions, Output, Over, table
from jaxbeam.runtime.printer import counted

if TYPE_CHECKING:
    from jaxbeam.analysis.bound.bound import Bound
    from jaxbeam.analysis.compare import Comparison, MetricsOverCases, PerformanceMetrics


def compare(
    case: Path,
    /,
    *,
    controllers: Annotated[tuple[Path, ...], Parameter(consume_multiple=True)] = (),
    over: Over = (),
    cases: Path | None = None,
    faults: Annotated[bool, Parameter(negative="")] = False,
    period: float | None = None,
    output: Output = None,
    pictures: DrawingOptions = DrawingOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Compare controllers on a case with each other, and with the least achievable peak.

    Parameters
    ----------
    case
        Case file, TOML; its own controller, if any, is compared too.
    controllers
        Files with a table [controller], or case files whose controllers are taken. Controllers
        are named after their files.
    cases
        Runs, TOML, as of `jaxbeam tune`: those of [held_out], or of [training], over loads,
        plants, delays, errors of gates (`controller.gate_errors.0`) and sensors, listed or drawn.
        Laws do not know what differs of beam, supports, actuators and sensors; a law drawn by hand
        is added.
    faults
        Compare under faults of which the laws do not know: 1 and 5 % of the readings lost, each
        sensor in turn stuck, readings and commands late by up to a fifth of the period, 12-bit
        converters, 15 % less rigidity.
    period
        Time (s) for which commands are held in the least achievable peak; if left out, the
        shortest period of the controllers, or 0.01.
    output
        Draw deflections and commands to this file, OUT.png, OUT.svg or OUT.pdf.
    """
    values = parse_sweep_values(over)
    pictures.check(output)
    refuse_option(bool(output and over), "a picture shows one load case: leave out -o or --over")
    refuse_option(bool(cases and over), "--cases has runs of its own: leave out --over")
    refuse_option(bool(output and cases), "a picture shows one load case: leave out -o or --cases")
    apart = faults and bool(output or over or cases)
    refuse_option(apart, "--faults prints a table of its own: leave out -o, --over and --cases")
    options.check_outputs(output)
    if cases is not None:
        check_exists("file of load cases", cases)
    for file in controllers:
        read_toml(file)
    parsed_case = options.read(case)

    from jaxbeam.analysis.compare import compare, metrics_over_cases
    from jaxbeam.case.case import value_words
    from jaxbeam.case.validation import check_case

    laws = _read_controllers(case, parsed_case, controllers)
    if cases is not None:
        _report_runs(parsed_case, laws, cases, period, options)
        return
    if faults:
        _report_faults(parsed_case, laws, period, options)
        return
    runs = [dict(zip(values, row, strict=True)) for row in itertools.product(*values.values())]
    load_cases = [jb.replace(parsed_case, run) for run in runs]
    for load_case in load_cases:
        check_case(load_case)
    comparisons = [compare(load_case, laws, period) for load_case in load_cases]
    if output:
        from jaxbeam.plot import plot_comparison

        figure = plot_comparison(comparisons[0], ax=pictures.page(), title=pictures.title)
        pictures.save(figure, output)
    if not over:
        options.report(_to_dict(comparisons[0]), _lines(comparisons[0]), output)
        return
    overall = metrics_over_cases(comparisons)
    lines = []
    for run, comparison in zip(runs, comparisons, strict=True):
        values_in_words = (value_words(parsed_case, *one) for one in run.items())
        lines.append("; ".join(values_in_words))
        lines += _lines(comparison)
    options.report(
        {
            "cases": [
                {"values": run} | _to_dict(comparison)
                for run, comparison in zip(runs, comparisons, strict=True)
            ],
            "over_all": {name: _overall_to_dict(metrics) for name, metrics in overall.items()},
        },
        [*lines, f"over all {len(comparisons)} load cases:", *_overall_table(overall)],
        output,
    )


def _report_runs(case, laws, path: Path, period, options: CaseOptions) -> None:
    """Report the controllers over the runs of a file."""
    from jaxbeam.analysis.compare import metrics_over_cases, worst_comparison
    from tuning.control.run_set import read_load_cases
    from tuning.control.tuning_result import compare_runs

    load_cases = read_load_cases(path, case)
    runs = load_cases.held_out or load_cases.training
    comparisons = compare_runs(case, laws, runs, period)
    overall = metrics_over_cases(comparisons)
    lines = [f"over {counted(len(runs), 'run')} of {path}:", *_overall_table(overall)]
    for name in overall:
        worst = worst_comparison(comparisons, name)
        where = ", ".join(f"{address} = {value:.4g}" for address, value in runs[worst].items())
        verdicts = [one.metrics[name].stability_margin.verdict for one in comparisons]
        unstable = verdicts.count("unstable")
        note = f"; unstable in {unstable} runs" if unstable else ""
        lines.append(f"{name}: worst at {where}{note}")
    options.report(
        {
            "cases": [
                {"values": run} | _to_dict(one) for run, one in zip(runs, comparisons, strict=True)
            ],
            "over_all": {name: _overall_to_dict(metrics) for name, metrics in overall.items()},
        },
        lines,
        None,
    )


def _report_faults(case, laws, period, options: CaseOptions) -> None:
    """Report the worst peaks of the controllers under each fault."""
    from jaxbeam.analysis.bound.bound import Bound
    from jaxbeam.analysis.compare import compare_under_faults, without_bound
    from jaxbeam.case.validation import check_case

    check_case(case)
    worst, least = compare_under_faults(case, laws, period)
    bounded = isinstance(least, Bound)

    def cell(one) -> str:
        if one is None:
            return "-"
        return f"{round(one.share if bounded else one.reduction, 3) + 0.0:.1%}"

    cells = [(name, *map(cell, of_faults.values())) for name, of_faults in worst.items()]
    what = "share of the attainable reduction" if bounded else "reduction of the peak"
    lines = [
        least.verdict if bounded else without_bound(least),
        f"{what}, at worst, under faults that the laws do not know:",
        *table(("controller", *next(iter(worst.values()))), cells),
    ]
    for name, of_faults in worst.items():
        if None in of_faults.values():
            lines.append(f"{name}: acts in continuous time, without samples to lose")
        for fault, one in of_faults.items():
            if one is not None and one.is_worse_than_none:
                ratio = f"{one.peak / one.uncontrolled:.3g} times the peak without control"
                how = "it diverges" if math.isnan(one.peak) else ratio
                lines.append(f"{name}, {fault}{one.at and f' ({one.at})'}: {how}")
    options.report(
        (_bound_to_dict(least) if bounded else _uncontrolled_to_dict(least))
        | {
            "faults": {
                name: {fault: one and one._asdict() for fault, one in of_faults.items()}
                for name, of_faults in worst.items()
            }
        },
        lines,
        None,
    )


def _read_controllers(path: Path, case: "jb.Case", files: tuple[Path, ...]) -> dict:
    """Controllers by name: that of the case, if any, and those of the files.

    Raises ValueError if two have the same name, or if there is none.
    """
    from jaxbeam.files.case_file import load_controller

    found = {} if case.controller is None else {path.stem: case.controller}
    for file in files:
        if file.stem in found:
            raise ValueError(f"two controllers are called {file.stem}; rename a file")
        found[file.stem] = load_controller(file)
    if not found:
        raise ValueError(f"{path} has no controller; name some with --controllers FILE ...")
    return found


def _to_dict(comparison: "Comparison") -> dict:
    """Numbers of a comparison by their names in JSON (SI units)."""
    none = _uncontrolled_to_dict(comparison.uncontrolled)
    return (_bound_to_dict(comparison.bound) if comparison.bound else none) | {
        "headline": comparison.headline,
        "controllers": {
            name: _metrics_to_dict(metrics)
            | {
                "damper_peak": getattr(comparison.damper_peaks.get(name), "peak", None),
                "dampers": comparison.damper_summary(name),
                "loop": comparison.loop_summary(name),
                "verdict": comparison.records[name].verdict,
            }
            for name, metrics in comparison.metrics.items()
        },
    }


def _bound_to_dict(bound: "Bound") -> dict:
    return {
        "uncontrolled_peak": bound.uncontrolled,
        "least_peak": bound.peak,
        "held_for": bound.period,
    }


def _uncontrolled_to_dict(uncontrolled) -> dict:
    """Numbers in place of those of a bound, of a run without control."""
    without = float(max(uncontrolled.peak_deflection))
    return {"uncontrolled_peak": without, "least_peak": None, "held_for": None}


def _metrics_to_dict(metrics: "PerformanceMetrics") -> dict:
    margin = metrics.stability_margin
    unstable = margin.unstable
    stability_margin = {
        "verdict": margin.verdict,
        "gain": margin.gain,
        "delay": margin.delay,
        "obstacle": margin.obstacle,
        "unstable": unstable
        and {
            "start": unstable.start,
            "end": unstable.end,
            "rate": unstable.rate,
            "frequency": unstable.frequency,
        },
    }
    limit_cycles = [
        {"extra": one.extra, "frequency": one.frequency, "at_limits": one.at_limits}
        for one in metrics.limit_cycles
    ]
    return {
        "peak": metrics.peak,
        "rms": metrics.rms,
        "after_exit": metrics.after_exit,
        "effort": metrics.effort,
        "saturated": metrics.saturated,
        "share": metrics.share,
        "stability_margin": stability_margin,
        "limit_cycles": limit_cycles,
        # Old names of the two, for one release.
        "reserve": stability_margin,
        "swings": limit_cycles,
    }


def _lines(comparison: "Comparison") -> list[str]:
    lines = table(
        (
            "controller",
            "peak (m)",
            "share of attainable reduction",
            "RMS (m)",
            "after exit (m)",
            "effort (command^2 s)",
            "time at limit",
            "gain margin",
            "delay margin (s)",
        ),
        [
            (
                name,
                f"{metrics.peak:.6g}",
                f"{metrics.share:.1%}" if comparison.bound else "-",
                f"{metrics.rms:.4g}",
                f"{metrics.after_exit:.4g}",
                " ".join(f"{effort:.4g}" for effort in metrics.effort),
                " ".join(f"{share:.1%}" for share in metrics.saturated),
                _margin_text(metrics, metrics.stability_margin.gain),
                _margin_text(metrics, metrics.stability_margin.delay),
            )
            for name, metrics in comparison.metrics.items()
        ],
    )
    return [comparison.headline, *lines, *comparison.remarks]


def _margin_text(metrics: "PerformanceMetrics", number: float) -> str:
    if metrics.stability_margin.obstacle:
        return "-"
    margin = metrics.stability_margin
    return margin.verdict if margin.verdict == "unstable" else f"{number:.3g}"


def _overall_to_dict(metrics: "MetricsOverCases") -> dict:
    return {
        "peak": metrics.peak,
        "worst_share": metrics.worst_share,
        "mean_share": metrics.mean_share,
        "after_exit": metrics.after_exit,
        "saturated": metrics.saturated,
    }


def _overall_table(overall: "dict[str, MetricsOverCases]") -> list[str]:
    return table(
        (
            "controller",
            "largest peak (m)",
            "worst share of attainable reduction",
            "mean share",
            "largest after exit (m)",
            "most time at limit",
        ),
        [
            (
                name,
                f"{metrics.peak:.6g}",
                *(
                    "-" if math.isnan(share) and math.isfinite(metrics.peak) else f"{share:.1%}"
                    for share in (metrics.worst_share, metrics.mean_share)
                ),
                f"{metrics.after_exit:.4g}",
                f"{metrics.saturated:.1%}",
            )
            for name, metrics in overall.items()
        ],
    )
