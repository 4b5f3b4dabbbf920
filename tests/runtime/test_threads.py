"""LAPACK has one thread, whether NumPy was imported before or after; a setting of users stays."""

import os
import subprocess
import sys

import pytest

COUNT = """
import threadpoolctl
print({library["num_threads"] for library in threadpoolctl.threadpool_info()})
"""


def available_cores() -> int:
    """Number of cores that this process may use; a system that binds none to processes has all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@pytest.mark.parametrize(
    ("lines", "setting", "threads"),
    [
        ("import numpy, jaxbeam", None, "{1}"),
        ("import numpy, tuning", None, "{1}"),
        ("import jaxbeam, numpy", None, "{1}"),
        ("import numpy, jaxbeam", "2", "{2}"),
    ],
)
def test_threads_of_lapack(lines, setting, threads):
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    if setting is not None:
        environment["OPENBLAS_NUM_THREADS"] = setting
    printed = subprocess.run(
        [sys.executable, "-c", lines + COUNT], env=environment, capture_output=True, check=True
    ).stdout
    if printed == b"set()\n":
        pytest.skip("NumPy was built without a library whose threads are known")
    if available_cores() > 1 or setting is None:
        assert printed.decode().strip() == threads
