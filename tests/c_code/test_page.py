"""The example of docs/export.md: the program that it writes repeats the simulated commands."""

import re
import shutil
from pathlib import Path

import pytest

from jaxbeam.cli import main

PAGE = (Path(__file__).parents[2] / "docs" / "export.md").read_text(encoding="utf-8")


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_example_runs_and_its_commands_are_equal(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    case, command, check = (
        re.findall(rf"```{re.escape(kind)}\n(.*?)```", PAGE, re.S)[0]
        for kind in ("{write} gates.toml", "{run-command}", "{run}")
    )
    Path("gates.toml").write_text(case)
    with pytest.raises(SystemExit) as ended:
        main(command.split()[1:])
    assert ended.value.code == 0 and "gates.c" in capsys.readouterr().out
    exec(check, {})  # fails if the check does
    assert capsys.readouterr().out.strip()
