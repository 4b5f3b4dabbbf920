"""The threads with which XLA runs searches: two of them waited for each other for ever."""

import os
import subprocess
import sys

import pytest

COUNT = """
import pathlib
import jaxbeam, tuning
import jax.numpy as jnp
jnp.ones(3).block_until_ready()
names = [(task / "comm").read_text() for task in pathlib.Path("/proc/self/task").iterdir()]
print(sum("XLAEigen" in name for name in names))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")
@pytest.mark.parametrize(("asked", "least", "most"), [(None, 8, os.cpu_count() or 8), (3, 3, 3)])
def test_searches_have_threads_enough(asked, least, most):
    environment = {name: value for name, value in os.environ.items() if name != "PJRT_NPROC"}
    if asked is not None:
        environment["PJRT_NPROC"] = str(asked)
    line = [sys.executable, "-c", COUNT]
    told = subprocess.run(line, capture_output=True, text=True, env=environment, check=True)
    assert least <= int(told.stdout) <= max(least, most)
