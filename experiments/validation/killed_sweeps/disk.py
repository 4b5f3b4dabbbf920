"""A Dask worker whose disk is slow, or full now and then, and whose clock is wrong.

    python -m experiments.validation.killed_sweeps.disk ADDRESS ...  # as `dask worker`

The environment has the numbers: KILLED_SWEEPS_SLOW, the mean time (s) of a write;
KILLED_SWEEPS_FULL, the share of writes that find no space; KILLED_SWEEPS_CLOCK, the seconds by
which the clock is ahead.
"""

import errno
import os
import random
import time

CLOCK = time.time
AHEAD = float(os.environ.get("KILLED_SWEEPS_CLOCK", "0"))


def change_writes() -> None:
    """Have blocks written slowly; the writing of some raises OSError, as without space."""
    from jaxbeam.simulation.sweeps import store

    slow, full = (float(os.environ.get(f"KILLED_SWEEPS_{name}", "0")) for name in ("SLOW", "FULL"))
    draws, append_block = random.Random(os.getpid()), store.append_block

    def append(file, block, results):
        """Append a block to a file, slowly; raises OSError at times."""
        time.sleep(draws.expovariate(1 / slow) if slow else 0.0)
        if draws.random() < full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append_block(file, block, results)

    store.append_block = append


if __name__ == "__main__":
    time.time = lambda: CLOCK() + AHEAD  # before Dask looks at it: a clock that jumps stops it
    from distributed.cli.dask_worker import main

    change_writes()
    main()
