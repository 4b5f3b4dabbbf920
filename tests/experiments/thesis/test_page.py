"""Counts of verdicts on the pages: computed from a report, and the same on all pages."""

import pytest

from experiments.thesis import page
from experiments.thesis.verdicts import EXPLAINED, NOT_REPRODUCED, NULL_MET, REPRODUCED

FINDING = {
    "where": "Table 9",
    "what": "peaks",
    "published": [1.0, 2.0, 3.0],
    "readings": {"as printed": [1.0, 2.5, 3.0], "else": [1.1, 2.0, float("nan")]},
    "reading": "else",
    "null model": "no control",
    "verdicts": [NULL_MET, EXPLAINED, NOT_REPRODUCED],
    "impossible because": "",
    "repeats": "",
    "remark": "the speed is not printed",
}
REPORT = {"experiments": {"one": {"findings": [FINDING]}, "none": {"findings": []}}}


def test_numbers_are_counted_and_listed_with_their_reasons():
    assert page.counts(REPORT) == {NULL_MET: 1, EXPLAINED: 1, NOT_REPRODUCED: 1}
    assert "Of the 3 numbers of the thesis that can be computed 2 count" in page.sentence(REPORT)
    text = page.page(REPORT)
    assert "- Table 9, peaks: 2 (2): else." in text
    assert "- Table 9, peaks: 3: the speed is not printed." in text
    assert "- Table 9, peaks: 1 (1.1): no control." in text
    assert "| all | 0 | 1 | 0 | 1 | 1 | 0 | 0 |" in text and "| none |" not in text


def test_counts_are_written_between_the_marks():
    text = f"before\n{page.BEGIN}\nold\n{page.END}\nafter"
    written = page.with_counts(text, REPORT)
    assert written == f"before\n{page.BEGIN}\n{page.sentence(REPORT)}\n{page.END}\nafter"
    assert page.with_counts(written, REPORT) == written
    with pytest.raises(ValueError, match="no marks"):
        page.with_counts("nothing", REPORT)


def test_shares_on_the_page_are_those_of_its_tables():
    results = page.RESULTS.read_text(encoding="utf-8")
    assert page.with_shares(results) == results
    with pytest.raises(ValueError, match="no marks"):
        page.with_shares("nothing")


def test_pages_have_the_same_counts():
    text = page.COUNTS.read_text(encoding="utf-8")
    sentence = text.partition(page.BEGIN)[2].partition(page.END)[0].strip()
    assert REPRODUCED in sentence and sentence in page.PAGE.read_text(encoding="utf-8")
