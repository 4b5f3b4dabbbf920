"""Fixtures of the command-line tests: a folder with a case file, and command lines run in it."""

import json

import pytest

from jaxbeam.cli import main
from tests.cli.example import CASE, CONTROLLED_CASE


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Current folder, with the files case.toml and controlled.toml."""
    (tmp_path / "case.toml").write_text(CASE)
    (tmp_path / "controlled.toml").write_text(CONTROLLED_CASE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(folder, capsys):
    """Run a command line that succeeds; returns its output, decoded if it is JSON."""

    def call(line: str):
        with pytest.raises(SystemExit) as ended:
            main(line.split())
        printed = capsys.readouterr()
        assert ended.value.code == 0, printed.err
        return json.loads(printed.out) if "--json" in line else printed.out

    return call


@pytest.fixture
def refused(folder, capsys):
    """Run a command line that is refused; returns the one sentence on standard error.

    The status is 1 for what the words name, 2 for the words themselves.
    """

    def call(line: str) -> str:
        with pytest.raises(SystemExit) as ended:
            main(line.split())
        printed = capsys.readouterr()
        assert ended.value.code in (1, 2)
        assert printed.out == ""
        assert printed.err.count("\n") == 1, "one sentence, no traceback"
        assert printed.err.startswith("jaxbeam: ")
        return printed.err.removeprefix("jaxbeam: ").strip()

    return call
