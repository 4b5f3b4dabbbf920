"""The thesis, reproduced: all experiments by name, run and written up in one report."""

import dataclasses
import importlib
import json
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import jax

import jaxbeam as jb
from experiments.thesis import report
from experiments.thesis.verdicts import VERDICTS, Experiment, Run, assign_verdicts
from jaxbeam import rigs
from jaxbeam.files.report import check_report_folder, write_report

MODULES = (
    "thesis.chapter2.frequencies",
    "thesis.chapter2.patches",
    "thesis.chapter2.amplification",
    "thesis.chapter2.shaker",
    "thesis.chapter2.identification",
    "thesis.chapter5.optimal_control",
    "studies.load_streams",
    "thesis.chapter6.feedback",
    "thesis.chapter7.predictive_control",
    "studies.tuned_feedforward",
    "studies.sensor_feedback",
)
OUTPUT_FOLDER = "out/reproduce"


def experiments() -> dict[str, Experiment]:
    """All experiments by name, in the order of the thesis."""
    found = (importlib.import_module(f"experiments.{name}").EXPERIMENT for name in MODULES)
    return {one.name: one for one in found}


def select_experiments(names: Sequence[str]) -> list[Experiment]:
    """The experiments of these names. Raises ValueError for a name that none has."""
    known = experiments()
    for name in names:
        if name not in known:
            raise ValueError(f"there is no experiment {name!r}; there are {', '.join(known)}")
    return [known[name] for name in names]


def run_experiment(experiment: Experiment, load_rig: Callable[[str], jb.Case] = rigs.load) -> Run:
    """Run one experiment on the published rigs, or on what is loaded in their place."""
    start = time.perf_counter()
    outcome = experiment.run(load_rig)
    return Run(experiment, outcome, assign_verdicts(outcome.findings), time.perf_counter() - start)


def reproduce(
    names: Sequence[str],
    folder: str | Path = OUTPUT_FOLDER,
    overwrite: bool = False,
    report_progress: Callable[[str], None] = print,
    processes: int = 1,
) -> list[Run]:
    """Run experiments and write figures, numbers and one report into a folder.

    So many `processes` share the experiments; each is told as text as soon as it and all before
    it are done. Raises ValueError for an unknown name,
    FileExistsError if the folder is not empty and may not be overwritten.
    """
    selected, folder = [one.name for one in select_experiments(names)], Path(folder)
    check_report_folder(folder, overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    runs = []
    for run in _run_all(selected, folder, processes):
        report_progress(report.text(run))
        runs.append(run)
    sections = report.report_sections(runs)
    write_report(folder, report.REPORT_TITLE, sections, style=report.VERDICT_STYLE, overwrite=True)
    (folder / "report.json").write_text(json.dumps(as_dict(runs), indent=2), encoding="utf-8")
    return runs


def _run_all(names: Sequence[str], folder: Path, processes: int) -> Iterator[Run]:
    """Runs of experiments, in their order, with their figures in the folder."""
    if processes == 1:
        yield from (_save_figures(run_experiment(one), folder) for one in select_experiments(names))
        return
    # Each process has a Python lock of its own, under which programs are traced.
    settings = (jax.config.jax_compilation_cache_dir,)
    pool = ProcessPoolExecutor(processes, get_context("spawn"), _initialise_process, settings)
    with pool:
        parts = pool.map(_run_in_process, names, [folder] * len(names))
        for experiment, part in zip(select_experiments(names), parts, strict=True):
            yield Run(experiment, *part)


def _run_in_process(name: str, folder: Path) -> tuple:
    """What a process brings back of an experiment: all but the experiment itself."""
    (one,) = select_experiments([name])
    _, *rest = _save_figures(run_experiment(one), folder)
    return tuple(rest)


def _save_figures(run: Run, folder: Path) -> Run:
    """Write the figures of a run; only their names are kept, for the report."""
    for name, figure in run.outcome.figures.items():
        figure.savefig(folder / f"{run.experiment.name}-{name}.png")
    names = dict.fromkeys(run.outcome.figures)
    return run._replace(outcome=dataclasses.replace(run.outcome, figures=names))


def _initialise_process(cache_folder: str | None) -> None:
    """Set a process up as the command line is: compiled programs are kept, warnings are short."""
    jax.config.update("jax_compilation_cache_dir", cache_folder)
    warnings.formatwarning = lambda message, *_: f"jaxbeam: warning: {message}\n"


def as_dict(runs: Sequence[Run]) -> dict:
    """All numbers and verdicts as plain lists and words."""
    return {
        "summary": {word: report.count_verdicts(runs, word) for word in VERDICTS},
        "experiments": {
            run.experiment.name: {
                "claim": run.experiment.claim,
                "seconds": run.seconds,
                "remarks": list(run.outcome.remarks),
                "findings": [
                    {
                        "where": one.published.location,
                        "what": one.published.quantity,
                        "unit": one.published.unit,
                        "kind": one.published.origin,
                        "tolerance": str(one.published.tolerance),
                        "labels": one.published.value_labels,
                        "published": one.published.numbers.tolist(),
                        "readings": {
                            k: list(map(float, v)) for k, v in one.interpretations.items()
                        },
                        "verdicts": judged.verdicts,
                        "obstacle": one.inconsistency,
                    }
                    for one, judged in zip(run.outcome.findings, run.judged, strict=True)
                ],
            }
            for run in runs
        },
    }
