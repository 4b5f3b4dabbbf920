"""The package without calls of POSIX, hard links and a C compiler, as on most Windows machines."""

import os
import subprocess
import sys

PROGRAM = """
import os
import signal
import sys

def no_links(*_, **__):
    raise OSError("no hard links here")

os.link = no_links
for name in ("getuid", "geteuid", "getgid", "fchmod", "fchown", "sched_getaffinity", "killpg",
             "setsid", "O_NOFOLLOW", "O_DIRECTORY", "O_NONBLOCK", "mkfifo"):
    if hasattr(os, name):
        delattr(os, name)
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
