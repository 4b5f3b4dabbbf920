"""Preload of a Dask worker: its disk is slow, or full now and then, and its clock is wrong.

    dask worker --preload experiments.validation.killed_sweeps.disk

The environment has the numbers: KILLED_SWEEPS_SLOW, the mean time (s) of a write;
KILLED_SWEEPS_FULL, the share of writes that find no space; KILLED_SWEEPS_CLOCK, the seconds by
which the clock is ahead.
"""

import errno
import os
import random
import time

from jaxbeam.sweeps.store import ZarrStore


def dask_setup(worker) -> None:
    """Change writes and clock of a worker."""
    slow, full, ahead = (
        float(os.environ.get(f"KILLED_SWEEPS_{name}", "0")) for name in ("SLOW", "FULL", "CLOCK")
    )
    draws, clock, result_array = random.Random(os.getpid()), time.time, ZarrStore._result_array

    def array(self, name, values):
        """The array of a result, just before a block is written to it."""
        time.sleep(draws.expovariate(1 / slow) if slow else 0.0)
        if draws.random() < full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return result_array(self, name, values)

    ZarrStore._result_array = array
    time.time = lambda: clock() + ahead
