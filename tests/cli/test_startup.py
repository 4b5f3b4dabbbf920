"""Help and errors in arguments come before anything heavy is imported."""

import json
import subprocess
import sys

import pytest

from jaxbeam.cli.commands.export import GAIN_FILES
from jaxbeam.files.export import WRITERS

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
