"""The validation page says what was found, and a check that fails is seen to fail."""

import pytest

from experiments.validation.checks import Check
from experiments.validation.page import validation_page


@pytest.mark.parametrize(
    ("error", "word", "count"),
    [(1e-9, "within", 1), (1e-3, "**above**", 0), (float("nan"), "**above**", 0)],
)
def test_page(error, word, count):
    text = validation_page([("A group", [Check("peaks", "closed form", error, 1e-6)])])
    assert f"**{count} of 1 checks" in text
    assert "## A group" in text
    assert f"| peaks | closed form | {error:.1e} | 1e-06 | {word} |" in text
