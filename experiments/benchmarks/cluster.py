"""A sweep of a million runs on a Dask cluster of this machine's cores, stored by the workers.

    python -m experiments.benchmarks.cluster [--runs 1000000] [--workers 2]

Masses by speeds on one span with three modes, peaks at three sensors to one part in ten million. A
tenth of the grid is swept first, untimed, so that all workers have compiled. The table has the
time, the rate, and the core hours of a billion runs at that rate.
"""

import tempfile
import time
from pathlib import Path

import jaxbeam as jb
from experiments.benchmarks.common import (
    one_span_case,
    parser,
    peak_memory,
    print_row,
    print_table,
    sweep_grid,
)


def time_sweep(runs: int, client, store: Path) -> tuple[int, float]:
    """Number of runs swept into a store, and the wall time (s).

    Raises RuntimeError if a run fails.
    """
    start = time.perf_counter()
    results = jb.sweep(
        one_span_case(3), sweep_grid(runs), store=store, progress=False, client=client
    )
    wall_time = time.perf_counter() - start
    if results.failed.any():
        raise RuntimeError(f"{int(results.failed.sum())} runs failed")
    return results.failed.size, wall_time


def main() -> None:
    """Sweep and print the table."""
    from distributed import Client, LocalCluster

    options = parser(__doc__)
    options.add_argument("--runs", type=int, default=1_000_000)
    options.add_argument("--workers", type=int, default=2)
    arguments = options.parse_args()
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalCluster(
            n_workers=arguments.workers, threads_per_worker=1, dashboard_address=":0"
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        stores = Path(folder)
        time_sweep(arguments.runs // 10, client, stores / "compiling.zarr")
        count, wall_time = time_sweep(arguments.runs, client, stores / "timed.zarr")
    header = "runs", "seconds", "runs a second", "peak memory here", "a billion runs"
    print_table(header, right_from=0)
    rate = count / wall_time
    hours = 1e9 / rate * arguments.workers / 3600
    memory = f"{peak_memory():.0f} MiB"
    print_row((str(count), f"{wall_time:.1f}", f"{rate:.0f}", memory, f"{hours:.0f} core hours"))


if __name__ == "__main__":
    main()
