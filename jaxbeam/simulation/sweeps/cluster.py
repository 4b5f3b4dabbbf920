"""Sweeps on a Dask cluster: workers compute blocks and write them to the store.

Only the path of the store and block numbers are sent. A worker makes the runner from the
specification and step sizes in the store, and appends each block to a file of its own. Dask gives
unfinished blocks of workers that die to other workers, which skip the blocks written already.
"""

import contextlib
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from pathlib import Path
from typing import TYPE_CHECKING

from jaxbeam.simulation.sweeps import store
from jaxbeam.simulation.sweeps.blocks import Runner
from jaxbeam.simulation.sweeps.specification import specification_from_dict

if TYPE_CHECKING:
    import distributed  # comes with the extra `cluster` only

MAX_BUNDLE = 16  # blocks sent at once; they take some tenths of a second
LONELY = 60.0  # s without any worker after which a sweep ends
CHECK = 5.0  # s, between two looks at the workers
BUNDLES_PER_THREAD = 4  # least number of bundles per thread, so that all threads end together


def connect(address: str) -> "distributed.Client":
    """Client of the Dask scheduler at an address such as tcp://10.0.0.1:8786.

    Raises ImportError without Dask, ConnectionError if no scheduler answers there.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ImportError(
            "sweeps on a cluster need Dask; install jaxbeam with the extra 'cluster': "
            "pip install 'jaxbeam[cluster]'"
        ) from None
    try:
        return Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ConnectionError(f"no Dask scheduler answers at {address}: {reason}") from None


def compute_blocks(
    client: "distributed.Client", fingerprint: str, path: Path, blocks: list[int]
) -> Iterator[int]:
    """Numbers of blocks as the workers of a cluster have computed and stored them.

    Raises RuntimeError without workers, if they keep dying, if none is left for LONELY seconds, or
    if the scheduler is lost; and the errors of workers.
    """
    from distributed import KilledWorker

    threads = sum(client.nthreads().values())
    if not threads:
        raise RuntimeError("the cluster has no workers; start some, then resume")
    size = max(1, min(MAX_BUNDLE, len(blocks) // (BUNDLES_PER_THREAD * threads)))
    bundles = [blocks[i : i + size] for i in range(0, len(blocks), size)]
    futures = client.map(compute_and_store, bundles, fingerprint=fingerprint, path=path, pure=False)
    try:
        for future in _completed(client, futures, path):
            yield from future.result()
    except CancelledError:
        raise RuntimeError(
            "the connection to the scheduler of the cluster is lost;"
            f" {store.kept_blocks(path)}: start it, then resume"
        ) from None
    except KilledWorker:
        raise RuntimeError(
            "workers keep dying (too little memory for each?);"
            f" {store.kept_blocks(path)}: mend this, then resume"
        ) from None
    finally:
        with contextlib.suppress(CancelledError, OSError, TimeoutError):
            client.cancel(futures)


def _completed(client: "distributed.Client", futures: list, path: Path) -> Iterator:
    """Futures as they end. Raises RuntimeError when no worker has been there for LONELY seconds."""
    from distributed import as_completed

    completed, last_seen = as_completed(futures, loop=client.loop), time.monotonic()
    next_check = last_seen + CHECK
    while not completed.is_empty():
        now = time.monotonic()
        if completed.has_ready():
            yield next(completed)
        elif now < next_check:
            time.sleep(0.005)
        else:
            next_check = now + CHECK
            if _has_workers_or_no_scheduler(client):
                last_seen = time.monotonic()  # without a scheduler the futures are cancelled
            elif now - last_seen > LONELY:
                raise RuntimeError(
                    f"the cluster has had no workers for {LONELY:.0f} s;"
                    f" {store.kept_blocks(path)}: start some, then resume"
                )


def _has_workers_or_no_scheduler(client: "distributed.Client") -> bool:
    """Whether a cluster has workers, or its scheduler does not answer."""
    try:
        return client.status != "running" or bool(client.nthreads())
    except OSError:  # lost since the last look; Dask has not noticed
        return True


def compute_and_store(blocks: list[int], fingerprint: str, path: Path) -> list[int]:
    """Compute blocks and write them to the store at a path; returns their numbers. Runs on workers.

    Raises ValueError if the store is not there, or if the versions of the worker differ from those
    of the fingerprint.
    """
    if store.status(path) != ("unfinished", fingerprint):
        raise ValueError(
            f"a worker does not find the sweep at {path}; put the store where all machines see it"
        )
    block_store = store.ZarrStore(path)
    runner, own_fingerprint = _runner(fingerprint, block_store)
    if own_fingerprint != fingerprint:
        raise ValueError(
            "a worker has another version of jaxbeam or JAX than the machine that started the"
            " sweep; install the same everywhere"
        )
    compute = runner.block_function(block_store.steps[:-1])
    for block in block_store.missing(blocks):
        block_store.write(block, compute(block))
    return blocks


_runners_lock = threading.Lock()
_runners: dict[str, tuple[Runner, str]] = {}


def _runner(fingerprint: str, block_store: store.ZarrStore) -> tuple[Runner, str]:
    """Runner of a sweep, made once per process, and its fingerprint in this process."""
    with _runners_lock:
        if fingerprint not in _runners:
            content = block_store.specification()
            specification = specification_from_dict(content)
            _runners.clear()
            runner = specification.resumed_runner(content)
            _runners[fingerprint] = runner, specification.fingerprint()
        return _runners[fingerprint]
