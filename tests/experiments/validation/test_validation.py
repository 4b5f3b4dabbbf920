"""The validation page marks errors above their tolerance, NaN included, and counts the others."""

import pytest

from experiments.validation.check import Check
from experiments.validation.page import validation_page


@pytest.mark.parametrize(
    ("error", "word", "count"),
    [(1e-9, "within", 1), (1e-3, "**above**", 0), (float("nan"), "**above**", 0)],
)
def test_page(error, word, count):
    text = validation_page([("A group", [Check("peaks", "closed form", error, 1e-6)])])
    assert f"**{count} of 1 errors" in text
    assert "## A group" in text
    assert f"| peaks | closed form | {error:.1e} | 1e-06 | {word} |" in text
