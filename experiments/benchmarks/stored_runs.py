"""Time, memory and place on disk of sweeps into a store, up to ten million runs.

    python -m experiments.benchmarks.stored_runs [--runs 100000 1000000 10000000]

Masses by speeds on one span with one mode, peaks at three sensors, by the C code where there is a
compiler. Every size is swept in its own process, after a small sweep that compiles everything.
Seconds are of the processor; memory is what the sweep adds to the peak of its process. In the
columns "over proportional" each is divided by that of the smallest size, and by the ratio of the
runs.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import jaxbeam as jb
from experiments.benchmarks.common import (
    COMPILED_RUNS,
    measure_in_subprocess,
    one_span_case,
    parser,
    peak_memory,
    print_row,
    print_table,
    sweep_grid,
)


def measure(runs: int) -> dict[str, float]:
    """Number of runs, processor time (s), peak memory with and without (MiB), MiB on disk.

    Raises RuntimeError if a run fails.
    """
    case = one_span_case(1)
    with tempfile.TemporaryDirectory() as folder:
        first, store = Path(folder) / "first.zarr", Path(folder) / "runs.zarr"
        jb.sweep(case, sweep_grid(COMPILED_RUNS), store=first, progress=False)
        before, start = peak_memory(), time.process_time()
        results = jb.sweep(case, sweep_grid(runs), store=store, progress=False)
        seconds, count = time.process_time() - start, results.failed.size
        if results.failed.any():
            raise RuntimeError(f"{int(results.failed.sum())} runs failed")
        disk = sum(path.stat().st_size for path in store.rglob("*") if path.is_file()) / 2**20
    return {"runs": count, "seconds": seconds, "memory": peak_memory() - before, "disk": disk}


def main() -> None:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("--runs", type=int, nargs="+", default=[10**5, 10**6, 10**7])
    options.add_argument("--measure", type=int, help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.measure is not None:
        print(json.dumps(measure(arguments.measure)))
        return
    over = "over proportional"
    print_table(("runs", "seconds", over, "MiB", over, "MiB on disk", over), right_from=0)
    first: dict[str, float] = {}
    for runs in arguments.runs:
        found = measure_in_subprocess("experiments.benchmarks.stored_runs", runs)
        first = first or found
        cells = [f"{found['runs']:.0f}"]
        for name in ("seconds", "memory", "disk"):
            grown = found[name] / first[name] * first["runs"] / found["runs"]
            cells += [f"{found[name]:.0f}", f"{grown:.2f}"]
        print_row(cells)


if __name__ == "__main__":
    main()
