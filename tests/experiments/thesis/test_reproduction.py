"""Verdicts on published numbers, reports of experiments, and the cheap experiments themselves."""

import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

import jaxbeam as jb
from experiments.thesis import reproduction
from experiments.thesis.verdicts import (
    EXPLAINED,
    IRREPRODUCIBLE,
    NOT_REPRODUCED,
    REPRODUCED,
    VERDICTS,
    PublishedNumbers,
    Tolerance,
    assign_verdicts,
    make_finding,
)
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
RELATIVE = Tolerance("for a test", relative=0.1)
TWO = PublishedNumbers("here", "two numbers", "m", "computed", RELATIVE, "1.0 20", "a b")


def verdicts(*findings):
    return [assigned.verdicts for assigned in assign_verdicts(findings)]


def test_verdicts():
    assert verdicts(make_finding(TWO, [1.1, 22.1])) == [[REPRODUCED, NOT_REPRODUCED]]
    assert verdicts(make_finding(TWO, [1.1, 22.1], inconsistency="of that")) == [
        [REPRODUCED, IRREPRODUCIBLE]
    ]
    assert verdicts(make_finding(TWO, [1.1, 0.0], {"else": [0.0, 20.0]})) == [
        [REPRODUCED, EXPLAINED]
    ]
    assert verdicts(make_finding(TWO, [np.nan, np.inf])) == [[NOT_REPRODUCED, NOT_REPRODUCED]]
    with pytest.raises(ValueError, match="2 numbers are printed"):
        make_finding(TWO, [1.0])


def test_one_interpretation_explains_all_numbers():
    """Of two alternatives that each explain other numbers, the one that explains most is taken."""
    first = make_finding(TWO, [0, 0], {"p": [1.0, 20.0], "q": [0.0, 0.0]})
    second = make_finding(TWO, [0, 0], {"p": [0.0, 0.0], "q": [1.0, 0.0]})
    assert verdicts(first, second) == [[EXPLAINED, EXPLAINED], [NOT_REPRODUCED, NOT_REPRODUCED]]


@pytest.mark.parametrize(
    ("tolerance", "values", "allowed"),
    [
        (RELATIVE, "2 -30", [0.2, 3.0]),
        (Tolerance("", absolute=1.0), "2 0.5", [1.0, 1.0]),
        (Tolerance("", digits=1), "20.387 326.2 100660 21", [0.001, 0.1, 10.0, 1.0]),
    ],
)
def test_tolerances(tolerance, values, allowed):
    printed = PublishedNumbers("", "", "", "", tolerance, values)
    np.testing.assert_allclose(printed.allowed_error, allowed)


def test_published_numbers_are_complete():
    assert len(PUBLISHED) > 60
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
    return {verdict: run.count(verdict) for verdict in VERDICTS}


def test_a_wrong_model_is_not_reproduced():
    """With half the rigidity no frequency and no critical speed is reproduced."""

    def wrong(name):
        case = rigs.load(name)
        return jb.replace(case, {"beam.flexural_rigidity": float(case.beam.flexural_rigidity) / 2})

    right, bad = verdict_counts("frequencies"), verdict_counts("frequencies", wrong)
    assert right[REPRODUCED] + right[EXPLAINED] >= 30
    # Independent of the rigidity: frequency parameters, errors in percent, mass ratios, and the
    # spurious frequency, which is that of a spring.
    assert bad[REPRODUCED] + bad[EXPLAINED] <= 8 + 3 + 2 + 1
    assert bad[NOT_REPRODUCED] >= right[NOT_REPRODUCED] + 15


def test_report(tmp_path, capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["reproduce", "patches", "-o", str(tmp_path / "out"), "--json"])
    printed = json.loads(capsys.readouterr().out)
    stored = json.loads((tmp_path / "out" / "report.json").read_text())
    assert printed["summary"] == stored["summary"]
    assert printed["summary"][REPRODUCED] + printed["summary"][EXPLAINED] == 4
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
    with pytest.raises(SystemExit, match="1"):
        main(["reproduce"])
    assert "--list" in capsys.readouterr().err


@pytest.mark.slow
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
