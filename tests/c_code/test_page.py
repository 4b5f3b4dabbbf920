"""The example of docs/export.md: its commands print what the page shows."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from jaxbeam.cli import main

PAGE = (Path(__file__).parents[2] / "docs" / "export.md").read_text(encoding="utf-8")


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_example_prints_what_the_page_shows(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    case, shown = (
        re.findall(rf"```{kind}\n(.*?)```", PAGE, re.S)[0] for kind in ("toml", "console")
    )
    Path("gates.toml").write_text(case)
    export, compilation = re.findall(r"\$ (.*)\n((?:[^$].*\n)*)", shown)
    with pytest.raises(SystemExit) as ended:
        main(export[0].split()[1:])
    assert ended.value.code == 0 and capsys.readouterr().out == export[1]
    printed = subprocess.run(compilation[0], shell=True, check=True, capture_output=True, text=True)
    assert printed.stdout == compilation[1]
