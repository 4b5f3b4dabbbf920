"""Verdicts on published numbers, reports of experiments, and the cheap experiments themselves."""

import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

import jaxbeam as jb
from experiments.thesis import reproduction
from experiments.thesis.published_numbers import PublishedNumbers
from experiments.thesis.report import ALL_VERDICTS
from experiments.thesis.verdicts import EXPLAINED, NOT_REPRODUCED, REPRODUCED
from jaxbeam import rigs
from jaxbeam.cli import main

CHAPTERS = [
    importlib.import_module(f"experiments.thesis.chapter{number}.published")
    for number in (2, 5, 6, 7)
]
PUBLISHED = {
    f"{chapter.__name__}.{name}": numbers
    for chapter in CHAPTERS
    for name, numbers in vars(chapter).items()
    if isinstance(numbers, PublishedNumbers)
}


def test_published_numbers_are_complete():
    assert len(PUBLISHED) > 55
    for name, one in PUBLISHED.items():
        assert one.origin in ("measured", "computed"), name
        assert len(one.value_labels) == one.numbers.size and np.all(one.allowed_error > 0), name


@pytest.mark.parametrize("chapter", CHAPTERS, ids=lambda chapter: chapter.__package__[-8:])
def test_every_published_number_has_a_finding_in_its_chapter(chapter):
    sources = Path(chapter.__file__).parent.glob("*.py")
    used = set(re.findall(r"published\.([A-Z]\w+)", "".join(map(Path.read_text, sources))))
    assert {
        name for name, one in vars(chapter).items() if isinstance(one, PublishedNumbers)
    } == used


@pytest.mark.parametrize("name", rigs.RIG_NAMES)
def test_published_rigs_are_cases(name):
    case = rigs.load(name)
    assert case.title.startswith(name) and case.loads and case.sensors


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="no published rig 'E'"):
        rigs.load("E")
    with pytest.raises(ValueError, match="no experiment 'x'; there are frequencies"):
        reproduction.select_experiments(["x"])


def verdict_counts(name, load_rig=rigs.load):
    run = reproduction.run_experiment(reproduction.select_experiments([name])[0], load_rig)
    return {verdict: run.count(verdict) for verdict in ALL_VERDICTS}


def test_a_wrong_model_is_not_reproduced():
    """With half the rigidity no frequency and no critical speed is reproduced."""

    def wrong(name):
        case = rigs.load(name)
        return jb.replace(case, {"beam.flexural_rigidity": float(case.beam.flexural_rigidity) / 2})

    right, bad = verdict_counts("frequencies"), verdict_counts("frequencies", wrong)
    assert right[REPRODUCED] + right[EXPLAINED] >= 14
    # Independent of the rigidity: four frequency parameters, two mass ratios.
    assert bad[REPRODUCED] + bad[EXPLAINED] <= 4 + 2
    assert bad[NOT_REPRODUCED] >= right[NOT_REPRODUCED] + 7


def test_report(tmp_path, capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["reproduce", "patches", "-o", str(tmp_path / "out"), "--json"])
    printed = json.loads(capsys.readouterr().out)
    stored = json.loads((tmp_path / "out" / "report.json").read_text())
    assert printed["summary"] == stored["summary"]
    assert printed["summary"][REPRODUCED] + printed["summary"][EXPLAINED] == 2
    for name in ("report.md", "report.html"):
        text = (tmp_path / "out" / name).read_text()
        assert "8.292e-4" in text and "patches-lift.png" in text and REPRODUCED in text
    assert (tmp_path / "out" / "patches-lift.png").stat().st_size > 10_000
    with pytest.raises(SystemExit, match="1"):
        main(["reproduce", "patches", "-o", str(tmp_path / "out")])
    assert "not empty" in capsys.readouterr().err


def test_list(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["reproduce", "--list"])
    assert "frequencies" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(["reproduce"])
    assert "--list" in capsys.readouterr().err


def test_experiments_in_two_processes(tmp_path):
    """Results come in order and equal those of one process; figures and report are written."""
    names = ["patches", "frequencies"]
    runs = reproduction.reproduce(names, tmp_path, processes=2, report_progress=lambda text: None)
    assert [run.experiment.name for run in runs] == names
    alone = reproduction.run_experiment(reproduction.select_experiments(names[:1])[0])
    assert runs[0].verdicts == alone.verdicts
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    for run in runs:
        for figure in run.outcome.figures:
            assert (tmp_path / f"{run.experiment.name}-{figure}.png").stat().st_size > 1000
            assert f"{run.experiment.name}-{figure}.png" in report
