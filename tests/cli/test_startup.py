"""Help and errors in arguments come before anything heavy is imported."""

import json
import shutil
import subprocess
import sys

import pytest

from jaxbeam.cli.app import COMMANDS, app, main
from jaxbeam.cli.commands.export import GAIN_FILES
from jaxbeam.export import WRITERS

HEAVY = ("jax", "numpy", "scipy", "equinox", "matplotlib", "xarray", "tuning", "experiments")

LINES = {
    "--help": "Simulation",
    "tune --help": "--pareto",
    "simulat case.toml": 'Unknown command "simulat"',
    "simulate case.toml --plott": "--plott",
    "simulate": "needs CASE",
    "simulate none.toml": "cannot read the case file none.toml",
    "simulate broken.toml": "not valid TOML",
    "simulate case.toml -o out.txt": "a record is written to a .nc file",
    "simulate case.toml --set loads.0.speed": "--set takes ADDRESS=VALUE",
    "sweep case.toml --over loads.0.speed=1:2": "a range is START:STOP:COUNT",
    "sweep case.toml --over loads.0.speed=1,2 --resume": "--resume needs the store",
    "frf case.toml --from 0": "--from and --to must increase",
    "export case.toml -o gains.txt": "gains are written to .csv",
    "tune case.toml --cases loads.toml --posterior": "it needs --fit",
    "identify case.toml log.csv --free beam.length=2:1": "bounds are LOW:HIGH",
    "identify case.toml none.csv --free beam.length": "none.csv: there is no such log file",
    "compare case.toml --controllers none.toml": "cannot read the case file none.toml",
    "weigh case.toml log.csv --speeds fast": "--speeds takes LOW:HIGH",
    "monitor none": "there is no folder none",
    "compare-models fit.npz": "one fit alone",
    "reproduce": "name an experiment",
    "describe --help": "static wheel loads",
    "describe none.toml": "cannot read the file none.toml",
}


@pytest.mark.parametrize("line", LINES)
def test_nothing_heavy_is_imported(folder, line):
    (folder / "broken.toml").write_text("[beam")
    code = (
        "import json, sys\n"
        "from jaxbeam.cli import main\n"
        "try: main()\n"
        f"finally: print(json.dumps([name for name in {HEAVY} if name in sys.modules]))"
    )
    command = [sys.executable, "-c", code, *line.split()]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    *printed, imported = ended.stdout.splitlines()
    assert LINES[line] in "\n".join(printed) + ended.stderr
    assert json.loads(imported) == []


def test_a_record_and_a_picture_need_no_package_that_takes_as_long_as_the_run(folder):
    slow = ("xarray", "pandas", "dask", "scipy.signal", "scipy.optimize", "matplotlib.pyplot")
    slow += ("jaxbeam.control.mpc", "jaxbeam.control.estimation.kalman")  # kinds of no part
    code = (
        "import json, sys\n"
        "from jaxbeam.cli import main\n"
        "try: main()\n"
        f"finally: print(json.dumps([name for name in {slow} if name in sys.modules]))"
    )
    command = [sys.executable, "-c", code, "simulate", "case.toml", "-o", "run.nc", "--plot"]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    assert (folder / "run.nc").exists() and (folder / "run.png").exists()
    assert json.loads(ended.stdout.splitlines()[-1]) == []


def test_help_names_every_command(run):
    printed = run("--help")
    for command in ("demo", "modes", "simulate", "sweep", "frf", "compare", "identify"):
        assert f" {command} " in printed


def test_export_knows_the_files_of_gains():
    assert tuple(WRITERS) == GAIN_FILES


def test_a_process_exits_with_status_one_and_no_traceback(folder):
    line = [sys.executable, "-m", "jaxbeam", "modes", "none.toml"]
    ended = subprocess.run(line, cwd=folder, capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr == (
        "jaxbeam: cannot read the case file none.toml: no such file or directory\n"
    )


# Completion of the command line in shells, and the status of wrong usage of every command.

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
