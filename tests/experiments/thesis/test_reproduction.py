"""The thesis reproduced: how verdicts come about, what reports hold, and the cheap experiments."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import jaxbeam as jb
from experiments.thesis import published, report, reproduction
from experiments.thesis.verdicts import (
    EXPLAINED,
    IRREPRODUCIBLE,
    NOT_REPRODUCED,
    REPRODUCED,
    PublishedNumbers,
    Tolerance,
    assign_verdicts,
    make_finding,
)
from jaxbeam import rigs
from jaxbeam.cli import main

RELATIVE = Tolerance("for a test", relative=0.1)
TWO = PublishedNumbers("here", "two numbers", "m", "computed", RELATIVE, "1.0 20", "a b")


def words(*findings):
    return [judged.verdicts for judged in assign_verdicts(findings)]


def test_verdicts():
    assert words(make_finding(TWO, [1.1, 22.1])) == [[REPRODUCED, NOT_REPRODUCED]]
    assert words(make_finding(TWO, [1.1, 22.1], inconsistency="of that")) == [
        [REPRODUCED, IRREPRODUCIBLE]
    ]
    assert words(make_finding(TWO, [1.1, 0.0], {"else": [0.0, 20.0]})) == [[REPRODUCED, EXPLAINED]]
    assert words(make_finding(TWO, [np.nan, np.inf])) == [[NOT_REPRODUCED, NOT_REPRODUCED]]
    with pytest.raises(ValueError, match="2 numbers are printed"):
        make_finding(TWO, [1.0])


def test_one_reading_serves_all():
    """Two readings that each fit another number: the one that fits most is taken for all."""
    first = make_finding(TWO, [0, 0], {"p": [1.0, 20.0], "q": [0.0, 0.0]})
    second = make_finding(TWO, [0, 0], {"p": [0.0, 0.0], "q": [1.0, 0.0]})
    assert words(first, second) == [[EXPLAINED, EXPLAINED], [NOT_REPRODUCED, NOT_REPRODUCED]]


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
    found = [one for one in vars(published).values() if isinstance(one, PublishedNumbers)]
    assert len(found) > 20
    for one in found:
        assert one.origin in ("measured", "computed"), one
        assert len(one.value_labels) == one.numbers.size and np.all(one.allowed_error > 0), one


def test_every_published_number_is_judged_in_an_experiment():
    sources = Path(published.__file__).parents[1].rglob("*.py")
    used = set(re.findall(r"published\.([A-Z]\w+)", "".join(map(Path.read_text, sources))))
    listed = {name for name, one in vars(published).items() if isinstance(one, PublishedNumbers)}
    assert listed == used & listed


@pytest.mark.parametrize("name", rigs.NAMES)
def test_published_rigs_are_cases(name):
    case = rigs.load(name)
    assert case.title.startswith(name) and case.loads and case.sensors


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="no published rig 'E'"):
        rigs.load("E")
    with pytest.raises(ValueError, match="no experiment 'x'; there are frequencies"):
        reproduction.chosen(["x"])


def tally(name, load=rigs.load):
    run = reproduction.perform(reproduction.chosen([name])[0], load)
    return {
        word: report.count([run], word)
        for word in (REPRODUCED, EXPLAINED, IRREPRODUCIBLE, NOT_REPRODUCED)
    }


def test_a_wrong_model_gets_a_bad_verdict():
    """With half the rigidity no frequency is right any more, nor is any speed."""

    def wrong(name):
        case = rigs.load(name)
        return jb.replace(case, {"beam.flexural_rigidity": float(case.beam.flexural_rigidity) / 2})

    right, bad = tally("frequencies"), tally("frequencies", wrong)
    assert right[REPRODUCED] + right[EXPLAINED] >= 30
    # What does not depend on the rigidity stays: parameters, errors in percent, mass ratios, and
    # the spurious frequency, which is that of a spring.
    assert bad[REPRODUCED] + bad[EXPLAINED] <= 8 + 3 + 2 + 1
    assert bad[NOT_REPRODUCED] >= right[NOT_REPRODUCED] + 15


def test_report(tmp_path, capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["reproduce", "patches", "-o", str(tmp_path / "out"), "--json"])
    printed = json.loads(capsys.readouterr().out)
    kept = json.loads((tmp_path / "out" / "report.json").read_text())
    assert printed["summary"] == kept["summary"]
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
def test_experiments_side_by_side(tmp_path):
    """Processes bring back, in order, what one alone finds; figures and report are written."""
    names = ["patches", "frequencies"]
    runs = reproduction.reproduce(names, tmp_path, processes=2, tell=lambda text: None)
    assert [run.experiment.name for run in runs] == names
    alone = reproduction.perform(reproduction.chosen(names[:1])[0])
    assert [judged.words for judged in runs[0].judged] == [j.words for j in alone.judged]
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    for run in runs:
        for figure in run.outcome.figures:
            assert (tmp_path / f"{run.experiment.name}-{figure}.png").stat().st_size > 1000
            assert f"{run.experiment.name}-{figure}.png" in report
