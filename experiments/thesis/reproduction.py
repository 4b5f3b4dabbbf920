"""Runs experiments by name, and writes their numbers, verdicts and figures to one report."""

import contextlib
import dataclasses
import importlib
import json
import multiprocessing
import signal
import time
import warnings
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import jax

import jaxbeam as jb
from experiments.thesis import report
from experiments.thesis.verdicts import (
    Experiment,
    ExperimentRun,
    Finding,
    FindingVerdicts,
    assign_verdicts,
    reading_name,
)
from jaxbeam.case.library import rigs
from jaxbeam.files.report import check_report_folder, write_report
from jaxbeam.runtime.interrupts import keeping
from jaxbeam.runtime.output_file import whole_file

MODULES = (
    "thesis.chapter2.frequencies",
    "thesis.chapter2.patches",
    "thesis.chapter2.amplification",
    "thesis.chapter2.shaker",
    "thesis.chapter2.identification",
    "thesis.chapter5.optimal_control",
    "thesis.chapter5.fed_back_states",
    "studies.load_streams",
    "thesis.chapter6.feedback",
    "thesis.chapter7.predictive_control",
    "studies.tuned_feedforward",
    "studies.sensor_feedback",
    "studies.fragility",
)
OUTPUT_FOLDER = "out/reproduce"
REPORT_FILES = "report.md", "report.html", "report.json"
LONGEST = ("optimal-control", "sensed")  # started first, so that no core waits for them at the end


def experiments() -> dict[str, Experiment]:
    """All experiments by name, in the order of the thesis."""
    modules = [importlib.import_module(f"experiments.{name}") for name in MODULES]
    return {module.EXPERIMENT.name: module.EXPERIMENT for module in modules}


def select_experiments(names: Sequence[str]) -> list[Experiment]:
    """Experiments by name. Raises ValueError for an unknown name."""
    available = experiments()
    for name in names:
        if name not in available:
            raise ValueError(f"there is no experiment {name!r}; there are {', '.join(available)}")
    return [available[name] for name in names]


def run_experiment(
    experiment: Experiment, load_rig: Callable[[str], jb.Case] = rigs.load
) -> ExperimentRun:
    """Run one experiment, with verdicts and wall time (s).

    `load_rig(name)` returns the case of a rig; the published rigs if left out.
    """
    start = time.perf_counter()
    outcome = experiment.run(load_rig)
    verdicts = assign_verdicts(outcome.findings)
    return ExperimentRun(experiment, outcome, verdicts, time.perf_counter() - start)


def reproduce(
    names: Sequence[str],
    folder: str | Path = OUTPUT_FOLDER,
    overwrite: bool = False,
    report_progress: Callable[[str], None] = print,
    processes: int = 1,
) -> list[ExperimentRun]:
    """Run experiments in `processes` and write report.md, .html, .json and figures to a folder.

    The report has the experiments that are done, so that an interrupt loses none of them.
    `report_progress` receives a line for each experiment when it is done, then the text of each:
    verdicts rest on all experiments of a rig. Raises ValueError for an unknown name,
    FileExistsError if the folder is not empty and `overwrite` is not set.
    """
    select_experiments(names)
    folder = Path(folder)
    check_report_folder(folder, overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    runs: list[ExperimentRun] = []
    kept: list[str] = []  # those in the report

    def sentence() -> str:
        left = " ".join(name for name in names if name not in kept)
        files = ", ".join(str(folder / name) for name in REPORT_FILES)
        words = f"{len(kept)} of {len(names)} experiments are kept in {files}"
        return f"{words}: go on with reproduce {left} and another folder" if kept else ""

    with keeping(sentence), contextlib.closing(_run_all(names, folder, processes)) as done:
        for run in done:
            runs = judged([*runs, run])
            _write(folder, runs)
            kept.append(run.experiment.name)
            numbers = sum(one.published.numbers.size for one in run.outcome.findings)
            report_progress(f"{run.experiment.name}: {numbers} numbers, {run.seconds:.0f} s")
    for run in runs:
        report_progress(report.as_text(run))
    return runs


def judged(runs: Sequence[ExperimentRun]) -> list[ExperimentRun]:
    """The runs with verdicts by the findings of all: a rig is that of several experiments."""
    assigned = iter(assign_verdicts([one for run in runs for one in run.outcome.findings]))
    return [run._replace(verdicts=[next(assigned) for _ in run.outcome.findings]) for run in runs]


def _write(folder: Path, runs: Sequence[ExperimentRun]) -> None:
    """Write the report of the experiments that are done, in place of that of fewer."""
    write_report(
        folder, report.TITLE, report.sections(runs), style=report.VERDICT_STYLE, overwrite=True
    )
    with whole_file(folder / REPORT_FILES[-1], overwrite=True) as partial:
        partial.write_text(json.dumps(as_dict(runs), indent=2), encoding="utf-8")


def _run_all(
    names: Sequence[str], folder: Path, processes: int
) -> Generator[ExperimentRun, None, None]:
    """Run experiments in order and save their figures to the folder."""
    selected = select_experiments(names)
    if processes == 1:
        yield from (_save_figures(run_experiment(one), folder) for one in selected)
        return
    # Processes, not threads: tracing holds Python's lock.
    settings = (jax.config.jax_compilation_cache_dir,)
    pool = ProcessPoolExecutor(processes, get_context("spawn"), _initialise_process, settings)
    with pool:
        in_order_of_start = sorted(names, key=lambda name: name not in LONGEST)
        results = {name: pool.submit(_run_in_process, name, folder) for name in in_order_of_start}
        try:
            for experiment in selected:
                yield ExperimentRun(experiment, *results[experiment.name].result())
        except (KeyboardInterrupt, GeneratorExit):
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _run_in_process(name: str, folder: Path) -> tuple:
    """Result, verdicts and wall time of an experiment, which itself cannot be pickled."""
    (experiment,) = select_experiments([name])
    _, *result = _save_figures(run_experiment(experiment), folder)
    return tuple(result)


def _save_figures(run: ExperimentRun, folder: Path) -> ExperimentRun:
    """Save the figures of a run to files, and drop them from it."""
    for name, figure in run.outcome.figures.items():
        if figure is not None:
            figure.savefig(folder / f"{report.figure_name(run, name)}.png")
    names = dict.fromkeys(run.outcome.figures)
    return run._replace(outcome=dataclasses.replace(run.outcome, figures=names))


def _initialise_process(cache_folder: str | None) -> None:
    """Settings of a worker process: the compile cache, warnings of one line, no word of Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    jax.config.update("jax_compilation_cache_dir", cache_folder)
    warnings.formatwarning = lambda message, *_: f"jaxbeam: warning: {message}\n"


def as_dict(runs: Sequence[ExperimentRun]) -> dict:
    """Numbers and verdicts of all runs as lists and strings, for JSON."""
    return {
        "summary": {word: sum(run.count(word) for run in runs) for word in report.ALL_VERDICTS},
        "experiments": {
            run.experiment.name: {
                "claim": run.experiment.claim,
                "seconds": run.seconds,
                "remarks": list(run.outcome.remarks),
                "findings": [
                    _finding_as_dict(finding, assigned)
                    for finding, assigned in zip(run.outcome.findings, run.verdicts, strict=True)
                ],
            }
            for run in runs
        },
    }


def _finding_as_dict(finding: Finding, assigned: FindingVerdicts) -> dict:
    published, reading = finding.published, assigned.reading & finding.answers
    return {
        "where": published.location,
        "what": published.quantity,
        "unit": published.unit,
        "kind": published.origin,
        "rig": published.rig,
        "tolerance": published.tolerance.basis,
        "allowed": published.allowed_error.tolist(),
        "labels": published.value_labels,
        "published": published.numbers.tolist(),
        "readings": {
            reading_name(answers): list(map(float, values))
            for answers, values in finding.readings.items()
        },
        "reading": reading_name(reading),
        "reading of the rig": reading_name(assigned.reading),
        "misfits": {
            finding.null.name if answers is None else reading_name(answers): value
            for answers, value in assigned.misfits.items()
        },
        "null model": finding.null.name,
        "null": list(map(float, finding.null.values)),
        "verdicts": assigned.verdicts,
        "impossible because": "; ".join(finding.impossible.values()),
        "inconsistent because": finding.inconsistent,
        "repeats": published.repeats,
        "remark": finding.remark,
    }
