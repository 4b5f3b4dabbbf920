"""A user's files `tuning.py` and `experiments.py` neither break jaxbeam nor are taken by it."""

import os
import subprocess
import sys

import pytest

from tests.modules import ROOT

FOREIGN = "raise SystemExit('a file of the user was run')\n"


@pytest.fixture
def folder(tmp_path):
    for name in ("tuning", "experiments"):
        (tmp_path / f"{name}.py").write_text(FOREIGN)
    return tmp_path


def run(folder, *words: str) -> subprocess.CompletedProcess:
    """A process in a folder, which Python searches before the folder of jaxbeam."""
    paths = os.environ | {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=paths, capture_output=True, text=True
    )


def test_commands_take_the_packages_of_jaxbeam(folder):
    listed = run(folder, "-m", "jaxbeam", "reproduce", "--list")
    assert (listed.returncode, listed.stderr) == (0, "")
    assert "covers" in listed.stdout


def test_the_demonstration_is_that_of_jaxbeam(folder):
    done = run(folder, "-m", "jaxbeam", "demo", "--output", ".")  # refused by `experiments.demo`
    assert done.returncode == 1 and done.stdout == ""
    assert "not empty" in done.stderr and "user" not in done.stderr


def test_the_documented_import_is_not_taken_by_a_file(folder):
    """Nor does it make a second class of what `import tuning` has from then on."""
    code = (
        "from jaxbeam import tuning as first\nimport jaxbeam.tuning as second, tuning\n"
        "print(first.identify.__module__, first.Fit is second.Fit is tuning.Fit)"
    )
    done = run(folder, "-c", code)
    assert done.stdout == "tuning.fit.identify True\n", done.stderr


def test_a_foreign_module_is_named_in_one_sentence(folder):
    (folder / "tuning.py").write_text("mine = 3\n")
    code = "import tuning\ntry:\n    from jaxbeam import tuning\nexcept ImportError as e: print(e)"
    done = run(folder, "-c", code)
    assert done.stdout == (
        f"{folder}/tuning.py was imported as 'tuning', the name of a package of jaxbeam:"
        " rename it, or import jaxbeam.tuning before it\n"
    )
    assert run(folder, "-c", "import jaxbeam, tuning\nprint(tuning.mine)").stdout == "3\n"


# The package without calls of POSIX, hard links and a C compiler, as on most Windows machines.

PROGRAM = """
import os
import shutil
import signal
import sys

def no_links(*_, **__):
    raise OSError("no hard links here")

os.link = no_links
for name in ("getuid", "geteuid", "getgid", "fchmod", "fchown", "sched_getaffinity", "killpg",
             "setsid", "O_NOFOLLOW", "O_DIRECTORY", "O_NONBLOCK", "mkfifo"):
    if hasattr(os, name):
        delattr(os, name)
os.process_cpu_count = os.cpu_count  # of Python 3.13, as where there is no sched_getaffinity
shutil._use_fd_functions = False  # as where there is no O_NONBLOCK
shutil._rmtree_impl = getattr(shutil, "_rmtree_unsafe", None)  # of Python 3.14
for name in ("SIGKILL", "SIGHUP", "SIGALRM", "pthread_sigmask", "setitimer", "pthread_kill"):
    if hasattr(signal, name):
        delattr(signal, name)
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None

import zarr.storage._local

def move(source, target):  # as `os.rename` does on Windows, which Zarr calls there
    if os.path.exists(target):
        raise FileExistsError(target)
    os.rename(source, target)

zarr.storage._local._safe_move = move

import jaxbeam as jb
from jaxbeam.runtime.cache_folder import read_file, write_file
from jaxbeam.runtime.native_library import find_compiler

assert find_compiler() is None
write_file("kept", b"content")
assert read_file("kept") == b"content"
case = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, modes=1),
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingForce(force=1.0, speed=2.0)],
    run=jb.Run(0.3),
)
record = jb.simulate(case)
record.save("run.nc")
jb.save(record, "run.csv")
runs = jb.sweep(case, {"loads.0.speed": [1.0, 2.0]}, store="runs", progress=False)
print(float(record.peak_deflection.max()), float(runs.peak_deflection[1].max()))
"""


def test_a_run_and_a_stored_sweep_without_links_users_and_a_compiler(tmp_path):
    own = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "PATH": ""}
    environment = {k: v for k, v in os.environ.items() if k not in ("CC", "LD_PRELOAD")} | own
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    single, swept = map(float, done.stdout.split())
    assert abs(swept - single) < 1e-5 * single
    assert {"run.nc", "run.csv", "runs"} <= {path.name for path in tmp_path.iterdir()}
