"""Number of XLA threads in a process that imports tuning: with two, XLA deadlocks."""

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
@pytest.mark.parametrize(
    ("requested", "least", "most"), [(None, 8, os.cpu_count() or 8), (3, 3, 3)]
)
def test_xla_has_at_least_eight_threads_unless_set_otherwise(requested, least, most):
    environment = {name: value for name, value in os.environ.items() if name != "PJRT_NPROC"}
    if requested is not None:
        environment["PJRT_NPROC"] = str(requested)
    line = [sys.executable, "-c", COUNT]
    counted = subprocess.run(line, capture_output=True, text=True, env=environment, check=True)
    assert least <= int(counted.stdout) <= max(least, most)
