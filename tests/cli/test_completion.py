"""Completion of the command line in shells, and the status of wrong usage of every command."""

import shutil
import subprocess

import pytest

from jaxbeam.cli.app import COMMANDS, app, main

NAMES = sorted(name for name in app if not name.startswith("-"))
PROGRAM = """
source "$0"
COMP_WORDS=(jaxbeam $1 "") COMP_CWORD=$(($# + 1)) COMP_WORDS[$COMP_CWORD]=$2
[ $# = 1 ] && COMP_WORDS=(jaxbeam "$1") COMP_CWORD=1
_jaxbeam
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture
def script(tmp_path, monkeypatch, capsys):
    """The script that `--install-completion` writes for a shell."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("ZSH", raising=False)
    monkeypatch.delenv("ZSH_CUSTOM", raising=False)

    def install(shell: str):
        with pytest.raises(SystemExit) as ended:
            main(["--install-completion", "--shell", shell])
        assert ended.value.code == 0
        printed = capsys.readouterr().out
        (path,) = (p for p in tmp_path.rglob("*jaxbeam*") if p.is_file() and str(p) in printed)
        return path

    return install


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_scripts_have_all_commands_and_options(script, shell):
    text = script(shell).read_text(encoding="utf-8")
    assert len(NAMES) == sum(map(len, COMMANDS.values()))
    assert all(name in text for name in NAMES)
    assert "line-speed" in text and "overwrite" in text


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(
    ("words", "expected"),
    [(["sim"], "simulate"), (["simulate", "--over"], "--overwrite")],
)
def test_bash_completes(script, words, expected):
    command = ["bash", "--norc", "-c", PROGRAM, str(script("bash")), *words]
    found = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert found == [expected]


@pytest.mark.parametrize("name", NAMES)
def test_every_command_ends_with_status_2_for_an_unknown_option(name, capsys):
    with pytest.raises(SystemExit) as ended:
        main([name, "--no-such-option"])
    printed = capsys.readouterr()
    assert (ended.value.code, printed.out, printed.err.count("\n")) == (2, "", 1)
