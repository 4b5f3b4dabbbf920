"""The validation page: its checks pass, and errors above their tolerance are marked."""

import pytest

from experiments.validation.check import Check
from experiments.validation.page import check_groups, validation_page


@pytest.mark.parametrize(
    ("error", "mark", "count"),
    [(1e-9, "within", 1), (1e-3, "**above**", 0), (float("nan"), "**above**", 0)],
)
def test_page_marks_errors_above_their_tolerance(error, mark, count):
    text = validation_page([("A group", [Check("peaks", "closed form", error, 1e-6)])])
    assert f"**{count} of 1 errors" in text
    assert "## A group" in text
    assert f"| peaks | closed form | {error:.1e} | 1e-06 | {mark} |" in text


@pytest.mark.parametrize("group", check_groups(), ids=lambda group: group.__name__)
@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_errors_are_within_their_tolerances(group):
    checks = list(group())
    assert checks and all(check.passed for check in checks), checks
