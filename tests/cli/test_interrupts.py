"""Ctrl-C at any moment ends a command in one line, which says what is kept, with status 130."""

import errno
import json
import subprocess
import sys

import numpy as np
import pytest
import tqdm

from jaxbeam.cli import main
from jaxbeam.cli.app import refuse_former_words
from jaxbeam.cli.commands import simulate
from jaxbeam.runtime.interrupts import interruptible, keeping
from jaxbeam.runtime.output_file import whole_file
from tuning.checkpoint import kept_in

# A command that gets SIGINT when it first, or a given time ("name*2"), imports a module, or opens a
# file, of some name.
SCRIPT = """
import os, signal, sys
sys.argv[0] = "jaxbeam"
moment, _, left = sys.argv.pop(1).partition("*")
left = int(left or 1)
def hook(event, arguments):
    global left
    if left and event in ("import", "open") and moment in f"{arguments[0]} {event}":
        left -= 1
        if not left:
            os.kill(os.getpid(), signal.SIGINT)
sys.addaudithook(hook)
from jaxbeam.cli import main
main()
"""
SWEEP = "sweep case.toml --over loads.0.speed=1:3:600 -o runs.zarr"
KEPT = "finished blocks are kept in runs.zarr"


def interrupted(folder, moment, line):
    command = [sys.executable, "-c", SCRIPT, moment, *line.split()]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    *before, last = ended.stderr.splitlines()
    assert ended.returncode == 130 and "Traceback" not in ended.stderr, ended.stderr
    assert last.startswith("jaxbeam: interrupted")
    assert not any(one.startswith("jaxbeam: interrupted") for one in before), "one line"
    assert not [path for path in folder.iterdir() if path.name.startswith(".") and "new" not in
                path.name], "nothing half written"  # fmt: skip
    return last.removeprefix("jaxbeam: ")


@pytest.mark.parametrize(
    ("moment", "line", "said"),
    [
        ("cyclopts", "simulate case.toml", "interrupted before any work"),
        ("jaxbeam.cli.commands.weigh", "modes case.toml", "interrupted before any work"),
        ("numpy", "modes case.toml", "interrupted; nothing is kept"),
        ("jaxlib.xla_client", "simulate case.toml", "interrupted; nothing is kept"),
        (".run.", "simulate case.toml -o run.nc", "interrupted; nothing is kept"),
        (".run.", "simulate case.toml -o out.nc --picture run.png", "interrupted; written: out.nc"),
        (".blocks open*2", SWEEP, f"interrupted; {KEPT}: resume it, with --resume"),
    ],
)
def test_one_line_says_what_is_kept(folder, moment, line, said):
    assert interrupted(folder, moment, line) == said


def test_a_sweep_goes_on_where_it_was_interrupted(folder, run):
    interrupted(folder, ".blocks open*2", SWEEP)
    assert (folder / "runs.zarr" / "blocks").is_dir()
    assert "600 runs, 0 failed" in run(f"{SWEEP} --resume")
    again = interrupted(folder, ".blocks open*2", f"{SWEEP} --overwrite")
    assert again == f"interrupted; {KEPT}: the same command goes on"


LOADS = '[training]\n"loads.0.mass" = [0.3, 0.5]\n'
LOG = "[columns]\nw = { unit = 'm', sensor = 0 }\n"
FREE = "--free controller.gains.0=50:400"
SEARCHES = {
    "fit": "identify case.toml log.csv --free beam.flexural_rigidity=5:20 --starts 10 -o fit.toml",
    "tuned": f"tune controlled.toml --cases loads.toml {FREE} -o tuned.toml",
}


@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_keeps_what_it_found(folder, name):
    """Interrupted as it writes its checkpoint the second time: the first is kept."""
    times = np.arange(0.0, 1.0, 0.005)
    rows = [f"{t:.6f},{-1e-3 * np.sin(np.pi * t) ** 2:.9e}\n" for t in times]
    (folder / "log.csv").write_text("time [s],w [m]\n" + "".join(rows))
    (folder / "log.toml").write_text(LOG)
    (folder / "loads.toml").write_text(LOADS)
    said = interrupted(folder, f".{name}.search.*2", SEARCHES[name])
    kept = f"{name}.search.npz"
    assert said == f"interrupted; the search is kept in {kept}: resume it, with --resume"
    assert (folder / kept).exists()


def test_experiments_that_are_done_are_kept(folder):
    """Interrupted as the report of the second is written: that of the first stays whole."""
    said = interrupted(folder, "r/.report.*4", "reproduce patches frequencies -o r")
    files = "r/report.md, r/report.html, r/report.json"
    kept = f"1 of 2 experiments are kept in {files}"
    assert said == f"interrupted; {kept}: go on with reproduce frequencies and another folder"
    assert list(json.loads((folder / "r/report.json").read_text())["experiments"]) == ["patches"]
    assert "patches" in (folder / "r/report.md").read_text()


def test_status_and_sentence_within_a_process(folder, capfd, monkeypatch):
    def stopped(*_, **__):
        with whole_file("a.csv") as partial:
            partial.write_text("1")
        with kept_in(folder / "none.npz"), keeping(lambda: "inner"), keeping(lambda: ""):
            raise KeyboardInterrupt

    monkeypatch.setattr(simulate, "print_plausibility", stopped)
    with pytest.raises(SystemExit) as ended:
        main(["simulate", "case.toml"])
    assert ended.value.code == 130
    assert capfd.readouterr().err == "jaxbeam: interrupted; inner; written: a.csv\n"


def test_the_line_is_not_behind_a_bar_of_progress(capfd):
    with tqdm.tqdm(total=2) as bar:
        bar.update()
        with pytest.raises(SystemExit), interruptible(of_process=False):
            raise KeyboardInterrupt
    said = capfd.readouterr().err.replace("\r", "\n").split("\n")
    assert "jaxbeam: interrupted; nothing is kept" in said


def test_checkpoints_are_named(tmp_path, capfd):
    (tmp_path / "search.npz").touch()
    search, other = tmp_path / "search.npz", tmp_path / "b"
    ends = pytest.raises(SystemExit)
    with ends, interruptible(False), kept_in(search, None), whole_file(other) as partial:
        partial.touch()
        raise KeyboardInterrupt
    said = f"the search is kept in {tmp_path / 'search.npz'}: resume it, with --resume"
    assert capfd.readouterr().err == f"jaxbeam: interrupted; {said}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["search.npz"]


def test_errors_pass(tmp_path):
    with pytest.raises(ZeroDivisionError), interruptible(of_process=False):
        raise ZeroDivisionError


def test_a_full_disk_below_the_output_is_told(folder):
    """Linux has a device that is always full."""
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "jaxbeam", "--help"]
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (ended.returncode, ended.stderr) == (1, "jaxbeam: no space left on device\n")


def test_a_full_disk_under_a_file_is_told_once(folder, monkeypatch, capsys):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("jaxbeam.runtime.output_file.os.replace", full)
    with pytest.raises(SystemExit):
        main(["simulate", "case.toml", "-o", "run.csv"])
    said = "jaxbeam: cannot write run.csv: no space left on device"
    assert capsys.readouterr().err.splitlines()[-1] == said


@pytest.mark.parametrize(
    ("words", "where"),
    [
        (["simulate", ""], "after simulate"),
        (["simulate", "case.toml", "-o", ""], "after -o"),
        (["simulate", "case.toml", "--output="], "--output="),
        ([""], "of the command"),
    ],
)
def test_an_empty_word_is_no_file(capsys, words, where):
    """As of a variable of the shell without a value; only a title may be empty."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    said = f"jaxbeam: a word of the command line is empty ({where}); give a name or value\n"
    assert (ended.value.code, capsys.readouterr().err) == (2, said)
    refuse_former_words(["simulate", "--title", "", "--title="])
