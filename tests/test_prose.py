"""Prose of pages, notebooks and docstrings: no words of `docs/words.toml`, none repeated.

`.ci/run` checks it with proselint as well, which is not installed for tests.
"""

import tomllib
from pathlib import Path

import pytest

from docs.check_prose import WORDS, Text, own_findings, prose, texts

LIST = tomllib.loads(WORDS.read_text(encoding="utf-8"))["words"]


def messages(text: str) -> list[str]:
    return [f"{f.line}: {f.message}" for f in own_findings(Text(Path("page.md"), 1, text), LIST)]


def test_pages_notebooks_and_docstrings():
    assert [finding for text in texts() for finding in own_findings(text, LIST)] == []


@pytest.mark.parametrize(
    "text, expected",
    [
        ("A line.\nThe campaign of logs.", ["2: 'campaign': data set"]),
        ("It is is wrong.", ["1: 'is is': a word is repeated"]),
        ("Optimised with scipy.optimize.", []),
        ("We optimize it.", ["1: 'optimize': British spelling: -ise"]),
        ("`campaign`\n\n```toml\ncampaign = 1\n```\n\n[text](campaign.md), $campaign$", []),
        ("# Modes\n\nModes are", []),
    ],
)
def test_findings(text, expected):
    assert messages(text) == expected


def test_what_is_no_prose_keeps_its_lines():
    text = "One.\n\n```python\nx = 1\n```\n\nTwo `code`.\n"
    assert prose(text).count("\n") == text.count("\n")
    assert [len(line.rstrip("·")) for line in prose(text).splitlines()] == [4, 0, 0, 0, 0, 0, 11]
