"""A sweep of a million runs on a Dask cluster of this machine's cores, each worker writing its own.

    python -m experiments.benchmarks.cluster [--runs 1000000] [--workers 2]

Masses by speeds of the one-span rig with three modes, peaks at three sensors to one part in ten
million. A tenth of the grid is swept first, so that all workers have compiled. Printed are the
time, the rate, and what a billion runs would take at that rate.
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

import jaxbeam as jb
from experiments.benchmarks.sweep import one_span_case


def grid(runs: int) -> dict[str, np.ndarray]:
    """About so many pairs of mass (kg) and speed (m/s)."""
    side = round(runs**0.5)
    return {
        "loads.0.mass": np.linspace(0.1, 1.0, side),
        "loads.0.speed": np.linspace(0.3, 10.0, side),
    }


def time_sweep(runs: int, client, store: Path) -> tuple[int, float]:
    """How many runs were swept into a store, and how long it took (s).

    Raises RuntimeError if one failed.
    """
    start = time.perf_counter()
    found = jb.sweep(one_span_case(3), grid(runs), store=store, progress=False, client=client)
    took = time.perf_counter() - start
    if found.failed.any():
        raise RuntimeError(f"{int(found.failed.sum())} runs failed")
    return found.failed.size, took


def main() -> None:
    """Sweep and print the table."""
    from distributed import Client, LocalCluster

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    print("| runs | seconds | runs a second | peak memory here | a billion runs |")
    print("| ---: | ---: | ---: | ---: | ---: |")
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalCluster(
            n_workers=given.workers, threads_per_worker=1, dashboard_address=":0"
        ) as machines,
        Client(machines, set_as_default=False) as client,
    ):
        for runs in (given.runs // 10, given.runs):
            count, took = time_sweep(runs, client, Path(folder) / f"{runs}.zarr")
            rate = count / took
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            hours = 1e9 / rate * given.workers / 3600
            print(
                f"| {count} | {took:.1f} | {rate:.0f} | {memory:.0f} MiB |"
                f" {hours:.0f} core hours |",
                flush=True,
            )


if __name__ == "__main__":
    main()
