"""Verdicts on published numbers, reports of experiments, and the cheap experiments themselves."""

import dataclasses
import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

import jaxbeam as jb
from experiments.thesis import page, reproduction
from experiments.thesis.chapter2.identification import HAND_FITTED, LOGS, fit_rig
from experiments.thesis.chapter5 import published as chapter5
from experiments.thesis.chapter6 import published as chapter6
from experiments.thesis.report import ALL_VERDICTS
from experiments.thesis.verdicts import (
    EXPLAINED,
    FITTED,
    INCONSISTENT,
    IRREPRODUCIBLE,
    NOT_REPRODUCED,
    NULL_MET,
    REPEATED,
    REPRODUCED,
    STATEMENT,
    YES_OR_NO,
    PublishedNumbers,
    Tolerance,
    assign_verdicts,
    make_finding,
    readings_of,
)
from jaxbeam.case.library import rigs
from jaxbeam.cli import main
from tests.tuning import make_rig_logs

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
        assert re.fullmatch(r".*rig [A-D], chapter \d", one.rig), name


def test_tolerances_of_measured_numbers_are_the_noise_of_the_sensors():
    """Twice the root of the printed variance, over static peaks by beam theory."""
    noise = 2e3 * np.sqrt(0.135e-10)
    np.testing.assert_allclose(chapter6.FREE_S1.allowed_error, noise)
    reductions = 100 * np.sqrt(2) * noise / np.array([0.676, 0.833, 0.959, 1.331])
    np.testing.assert_allclose(chapter6.CUBIC_REDUCTION_S1.allowed_error, reductions)
    masses = np.array([0.261, 0.509])
    peaks = 1e3 * 9.81 * masses * 0.6**3 / (48 * 13.211)  # g m L^3 / (48 E I)
    np.testing.assert_allclose(chapter6.ONE_SPAN_PEAKS, peaks, rtol=3e-3)
    # A load at s on a pinned beam with a spring at 0.5 m: by influence coefficients in E I = 11.68.
    s = np.linspace(0.0, 0.6, 601)[1:-1]
    force = influence(0.5, s) / (influence(0.5, np.array([0.5])) + 1 / 12000.0)
    sinking = influence(0.25, s) - force * influence(0.25, np.array([0.5]))
    masses = np.array([0.261, 0.371, 0.509])
    np.testing.assert_allclose(chapter5.PEAKS, 9.81e3 * masses * sinking.max(), rtol=3e-3)


def influence(x, s):
    """Deflection of a pinned beam of 0.6 m and 11.68 N m^2 at x by a unit force at s (m/N)."""
    length, rigidity = 0.6, 11.68
    low, high = np.minimum(x, s), np.maximum(x, s)
    b = length - high
    return b * low * (length**2 - b**2 - low**2) / (6 * length * rigidity)


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
    """With half the rigidity no frequency of one number is reproduced."""

    def wrong(name):
        case = rigs.load(name)
        return jb.replace(case, {"beam.flexural_rigidity": float(case.beam.flexural_rigidity) / 2})

    right, bad = verdict_counts("frequencies"), verdict_counts("frequencies", wrong)
    assert right[REPRODUCED] + right[EXPLAINED] >= 11
    assert bad[REPRODUCED] + bad[EXPLAINED] <= 4  # frequency parameters, of any rigidity
    assert bad[NOT_REPRODUCED] >= right[NOT_REPRODUCED] + 7


def test_report(tmp_path, capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["reproduce", "patches", "-o", str(tmp_path / "out"), "--json"])
    printed = json.loads(capsys.readouterr().out)
    stored = json.loads((tmp_path / "out" / "report.json").read_text())
    assert printed["summary"] == stored["summary"]
    assert printed["summary"][REPEATED] == 2
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


# Verdicts on published numbers: tolerances, null models, fitted and repeated numbers, readings.

RELATIVE = Tolerance("for a test", relative=0.1)
TWO = PublishedNumbers("here", "two numbers", "m", "1.0 20", "a b", tolerance=RELATIVE)
FAR = ("nothing", 0.0)


def verdicts(*findings):
    return [assigned.verdicts for assigned in assign_verdicts(findings)]


def test_verdicts():
    assert verdicts(make_finding(TWO, [1.1, 22.1], null=FAR)) == [[REPRODUCED, NOT_REPRODUCED]]
    proof = make_finding(TWO, [1.1, 22.1], null=FAR, impossible={"b": "of that"})
    assert verdicts(proof) == [[REPRODUCED, IRREPRODUCIBLE]]
    together = make_finding(TWO, [1.2, 22.1], null=FAR, impossible={"b": "it"}, inconsistent="both")
    assert verdicts(together) == [[INCONSISTENT, IRREPRODUCIBLE]]
    other = make_finding(TWO, [1.1, 0.0], {"else": [1.1, 20.0]}, null=FAR)
    assert verdicts(other) == [[REPRODUCED, EXPLAINED]]
    nearer = make_finding(TWO, [1.1, 0.0], {"else": [1.0, 20.0]}, null=FAR)
    assert verdicts(nearer) == [[EXPLAINED, EXPLAINED]]
    nothing = make_finding(TWO, [np.nan, np.inf], null=FAR)
    assert verdicts(nothing) == [[NOT_REPRODUCED, NOT_REPRODUCED]]
    with pytest.raises(ValueError, match="2 numbers are printed"):
        make_finding(TWO, [1.0], null=FAR)
    with pytest.raises(ValueError, match="none: 2 numbers are printed"):
        make_finding(TWO, [1.0, 2.0], null=("none", [0.0, 0.0, 0.0]))


def test_what_the_null_model_meets_counts_for_nothing():
    one = make_finding(TWO, [1.0, 20.0], null=("no control", [0.95, 17.0]))
    assert verdicts(one) == [[NULL_MET, REPRODUCED]]
    missed = make_finding(TWO, [1.15, 20.0], null=("no control", [1.0, 16.0]))
    assert verdicts(missed) == [[NOT_REPRODUCED, REPRODUCED]]
    alike = make_finding(TWO, [1.08, 20.0], null=("no control", [1.12, 16.0]))
    assert verdicts(alike) == [[NULL_MET, REPRODUCED]]


def test_a_yes_or_a_no_counts_for_nothing():
    published = PublishedNumbers("here", "", "", "1 0", "a b", tolerance=YES_OR_NO)
    one = make_finding(published, [1.0, 1.0], null=FAR)
    assert verdicts(one) == [[STATEMENT, STATEMENT]]
    assert one.misfit(frozenset()) == 0.0


def test_an_interpretation_less_likely_than_the_null_model_explains_nothing():
    one = make_finding(TWO, [0.0, 0.0], {"p": [1.1, 0.0]}, null=("static", [1.11, 22.2]))
    assert verdicts(one) == [[NOT_REPRODUCED, NOT_REPRODUCED]]


def test_a_number_that_a_parameter_was_fitted_to_counts_for_nothing():
    one = make_finding(TWO, [0, 0], {"p": [1.0, 20.0]}, null=FAR, fitted={"p": "b"})
    assert verdicts(one) == [[EXPLAINED, FITTED]]
    assert one.misfit(frozenset({"p"})) == 2.0 and one.misfit(frozenset()) == 72.0


def test_numbers_that_repeat_others_count_for_nothing():
    published = PublishedNumbers(
        "here", "", "", "1.0 20", "a b", tolerance=RELATIVE, repeats="there", repeated_labels="a"
    )
    one = make_finding(published, [1.0, 20.0], null=FAR)
    assert verdicts(one) == [[REPEATED, REPRODUCED]]
    assert make_finding(published, [5.0, 20.0], null=FAR).misfit(frozenset()) == 0.0


def test_one_interpretation_serves_for_all_numbers():
    """The likeliest is taken, for hits and for misses; nothing is picked from the others."""
    first = make_finding(TWO, [1, 0], {"p": [0.0, 20.0], "q": [0.0, 0.0]}, null=FAR)
    second = make_finding(TWO, [0, 0], {"p": [1.0, 0.0], "q": [1.0, 0.0]}, null=FAR)
    assert assign_verdicts([first, second])[0].reading == {"p"}
    assert verdicts(first, second) == [[NOT_REPRODUCED, EXPLAINED], [EXPLAINED, NOT_REPRODUCED]]


def test_one_reading_serves_for_all_findings_of_a_rig():
    """Also where they ask different questions; findings of another rig have a reading of their own.

    The first alone would take p, the second leaves q alone; "r" is a question of the second only.
    """
    other = dataclasses.replace(TWO, rig="other")
    first = make_finding(TWO, [5, 5], {"p": [1.0, 20.0], "q": [1.0, 30.0]}, null=FAR)
    second = make_finding(
        TWO, [5, 5], {"p": [5, 5], "q": [1.0, 5], ("q", "r"): [1.0, 20.0]}, null=FAR
    )
    third = make_finding(other, [5, 5], {"p": [1.0, 20.0], "q": [1.0, 30.0]}, null=FAR)
    assert set(readings_of([first, second])) == {
        frozenset(one) for one in ((), ("p",), ("q",), ("q", "r"))
    }
    assert assign_verdicts([first, second])[0].reading == {"q", "r"}
    assert verdicts(first, second, third) == [
        [EXPLAINED, NOT_REPRODUCED],
        [EXPLAINED, EXPLAINED],
        [EXPLAINED, EXPLAINED],
    ]


def test_questions_that_other_findings_ask_are_answered_apart():
    first = make_finding(TWO, [5, 5], {"p": [1.0, 20.0]}, null=FAR)
    second = make_finding(TWO, [5, 5], {"q": [1.0, 20.0]}, null=FAR)
    assert len(readings_of([first, second])) == 4
    assert assign_verdicts([first, second])[0].reading == {"p", "q"}


def test_parameters_that_explain_no_more_than_themselves_do_not_make_an_interpretation_likelier():
    near = make_finding(TWO, [1.05, 20.0], {"p": [1.0, 20.0]}, null=FAR, fitted={"p": "a"})
    assert assign_verdicts([near])[0].reading == frozenset()


@pytest.mark.parametrize(
    ("tolerance", "values", "allowed"),
    [
        (RELATIVE, "2 -30", [0.2, 3.0]),
        (Tolerance("", absolute=1.0), "2 0.5", [1.0, 1.0]),
        (Tolerance("", digits=1), "20.387 326.2 100660 21 340", [0.001, 0.1, 10.0, 1.0, 1.0]),
        (Tolerance("", digits=1), "8.292e-4 -6250 3e12", [1e-7, 10.0, 1e12]),
    ],
)
def test_tolerances(tolerance, values, allowed):
    printed = PublishedNumbers("", "", "", values, origin="", tolerance=tolerance)
    np.testing.assert_allclose(printed.allowed_error, allowed)


# The tables of the page on results are those of the report.


def rig(*shares: tuple[str, float, float]) -> list[str]:
    return [f"{k}: at least {a}% of the achievable, {b}% in the mean" for k, a, b in shares]


TABLES = (page.TUNED_ROWS, page.SENSED_ROWS)
LABELS = [labels for rows in TABLES for labels in rows.values()]
SHARES = [
    ["B: one span", *rig(*((labels[0], 90.0, 95.0) for labels in LABELS))],
    ["C: two spans", "0.4 kg: tuned 3%; at most 4%", *rig(*((x[-1], -8.0, 9.0) for x in LABELS))],
]
FRAGILE = [
    "0.4 kg; shares",
    "as tuned: hand-set trapezium 98.4%, tuned, bench 97.1%",
    "filter: tuned, sensors only -2.0%",
    "lift: tuned, bench 0.35 mm",
]
REPORT = {
    "experiments": {
        "tuned": {"remarks": sum(SHARES, [])},
        "sensed": {"remarks": sum(SHARES, [])},
        "fragile": {"remarks": FRAGILE},
    }
}
MARKED = "".join(f"<!-- {n} -->old<!-- end of {n} -->\n" for n in ("tuned", "sensed", "fragile"))


def test_tables_are_written_between_their_marks():
    written = page.with_tables(MARKED, REPORT)
    assert "old" not in written and page.with_tables(written, REPORT) == written
    assert "| tuned table | 90.0 % (95.0 %) | worse than no control |" in written
    assert "| as tuned | 98.4 % | 97.1 % |  |  |  |" in written
    assert "| filter |  |  |  |  | worse than no control |" in written and "lift" not in written
    with pytest.raises(ValueError, match="no marks <!-- sensed -->"):
        page.with_tables(MARKED.replace("sensed", "x"), REPORT)


# Counts of verdicts on the pages: computed from a report, and the same on all pages.

FINDING = {
    "where": "Table 9",
    "what": "peaks",
    "published": [1.0, 2.0, 3.0],
    "readings": {"as printed": [1.0, 2.5, 3.0], "else": [1.1, 2.0, float("nan")]},
    "reading": "else",
    "null model": "no control",
    "rig": "rig A",
    "reading of the rig": "else",
    "verdicts": [NULL_MET, EXPLAINED, NOT_REPRODUCED],
    "impossible because": "",
    "inconsistent because": "",
    "repeats": "",
    "remark": "the speed is not printed",
}
VERDICTS = {"experiments": {"one": {"findings": [FINDING]}, "none": {"findings": []}}}


def test_numbers_are_counted_and_listed_with_their_reasons():
    assert page.counts(VERDICTS) == {NULL_MET: 1, EXPLAINED: 1, NOT_REPRODUCED: 1}
    assert "Of the 3 numbers of the thesis that can be computed 2 count" in page.sentence(VERDICTS)
    text = page.page(VERDICTS)
    assert "- Table 9, peaks: 2 (2)." in text
    assert "- Table 9, peaks: 3: the speed is not printed." in text
    assert "no control." not in text  # counts for nothing
    assert "- rig A: else." in text
    assert "| all | 0 | 1 | 0 | 0 | 1 | 1 | 0 | 0 | 0 |" in text and "| none |" not in text


def test_counts_are_written_between_the_marks():
    text = f"before\n{page.BEGIN}\nold\n{page.END}\nafter"
    written = page.with_counts(text, VERDICTS)
    assert written == f"before\n{page.BEGIN}\n{page.sentence(VERDICTS)}\n{page.END}\nafter"
    assert page.with_counts(written, VERDICTS) == written
    with pytest.raises(ValueError, match="no marks"):
        page.with_counts("nothing", VERDICTS)


def test_shares_on_the_page_are_those_of_its_tables():
    results = page.RESULTS.read_text(encoding="utf-8")
    assert page.with_shares(results) == results
    with pytest.raises(ValueError, match="no marks"):
        page.with_shares("nothing")


def test_pages_have_the_same_counts():
    text = page.COUNTS.read_text(encoding="utf-8")
    sentence = text.partition(page.BEGIN)[2].partition(page.END)[0].strip()
    assert REPRODUCED in sentence and sentence in page.PAGE.read_text(encoding="utf-8")


# Identification of the numbers fitted by hand, from logs made by finite elements.


def test_intervals_of_rig_b_contain_the_true_values():
    """The log in the repository is the one that `make_rig_logs` makes."""
    stored = np.loadtxt(LOGS / "B.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(stored, make_rig_logs.make("B"), atol=2e-5)
    assert (LOGS / "B.toml").read_text(encoding="utf-8") == make_rig_logs.description("B")
    fit = fit_rig("B", rigs.load)
    low, high = fit.intervals.T
    truth = np.array(list(HAND_FITTED["B"].values()))
    assert np.all((low < truth) & (truth < high)), str(fit)
    assert np.all(high - low < 0.1 * truth)
