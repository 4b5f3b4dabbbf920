"""Metadata agree: versions, dates, and names for those who cite and contribute."""

import re
import tomllib

import pytest

import jaxbeam as jb
from tests.modules import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_citation_has_the_version_and_date_of_the_changelog():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    version = PROJECT["version"]
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    released = re.search(rf"^## {re.escape(version)} \((\d{{4}}-\d\d-\d\d)\)", changelog, re.M)
    assert f"\nversion: {version}\n" in citation
    assert released and f'date-released: "{released[1]}"' in citation


def test_classifiers_are_of_the_python_versions_that_are_allowed():
    least = int(PROJECT["requires-python"].removeprefix(">=3."))
    named = [int(one.split("3.")[1]) for one in PROJECT["classifiers"] if "Python :: 3." in one]
    assert named == list(range(least, max(named) + 1))
    assert PROJECT["classifiers"] == sorted(PROJECT["classifiers"])


@pytest.mark.parametrize("name", ["AGENTS.md", "llms.txt", "CODE_OF_CONDUCT.md"])
def test_files_and_names_that_are_named_exist(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    paths = set(re.findall(r"\]\(([\w./-]+)\)", text))
    paths |= {one for one in re.findall(r"[`\s]([\w./]+\.(?:md|py|pyi))\b", text)}
    paths |= {one for one in re.findall(r"`([.\w/]+/)`", text)}
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []
    assert len(text.split()) < 400
    for function in re.findall(r"\bjb\.(\w+)", text):
        assert hasattr(jb, function)


def test_the_lines_for_assistants_run():
    lines = re.findall(r"^    (.*)$", (ROOT / "llms.txt").read_text(encoding="utf-8"), re.M)
    found: dict = {}
    exec("\n".join(lines[:-1]), found)  # all but the sweep
    assert found["record"].peak_deflection[0] > 0
    assert jb.check(found["case"]).warnings == ()
