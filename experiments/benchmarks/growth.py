"""Time and peak memory of a sweep as it grows, and the time of compiling it.

    python -m experiments.benchmarks.growth [--runs 4096 40000 400000 4000000]

Masses by speeds on one span with three modes, peaks at three sensors. Every size is swept in its
own process, whose peak memory the operating system reports, by XLA, and in another with the C code.
Everything is compiled before, by a sweep of 64 by 64 and one of all masses and some of the speeds.
The first sweep is timed in two processes that share a new compile cache: one compiles, the other
reads.
"""

import argparse
import contextlib
import json
import tempfile
import time

import xarray

from experiments.benchmarks.common import (
    COMPILED_RUNS,
    measure_in_subprocess,
    one_span_case,
    parser,
    peak_memory,
    print_row,
    print_table,
    sweep_grid,
    without_native,
)
from jaxbeam.simulation.sweeps.sweep import sweep


def measure(runs: int, native: bool = False) -> dict[str, float]:
    """Wall times (s) of the first sweep and of one of so many runs, and memory (MiB).

    With `native` by the C code, where there is a compiler. Raises RuntimeError if a run fails.
    """
    case, times, over = one_span_case(3), [], sweep_grid(runs)
    xarray.Dataset({"loaded": ("run", [0.0])})  # xarray imports modules at first use
    # Shapes of blocks depend on the number of masses: all of them and some speeds compile all.
    speeds = over["loads.0.speed"]
    some = over | {"loads.0.speed": speeds[:: -(-len(speeds) // 16)]}
    before = 0.0
    for values in (sweep_grid(COMPILED_RUNS), sweep_grid(COMPILED_RUNS), some, over):
        before = peak_memory()
        start = time.perf_counter()
        with contextlib.nullcontext() if native else without_native():
            results = sweep(case, values, progress=False)
        times.append(time.perf_counter() - start)
        if results.failed.any():
            raise RuntimeError(f"{int(results.failed.sum())} runs failed")
    peak = peak_memory()
    return {"first": times[0], "again": times[1], "run": times[3], "before": before, "peak": peak}


def measure_with_cache(runs: int, cache: str, native: bool = False) -> dict[str, float]:
    """`measure` in its own process, with a compile cache in a folder."""
    settings = {
        "XDG_CACHE_HOME": cache,
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    module = "experiments.benchmarks.growth"
    return measure_in_subprocess(module, runs, int(native), environment=settings)


def main() -> None:
    """Print the tables."""
    options = parser(__doc__)
    options.add_argument("--runs", type=int, nargs="+", default=[4096, 40_000, 400_000, 4_000_000])
    options.add_argument("--measure", type=int, nargs=2, help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.measure is not None:
        runs, native = arguments.measure
        print(json.dumps(measure(runs, bool(native))))
        return
    with tempfile.TemporaryDirectory() as cache:
        print_table(("compiling a sweep", "seconds"))
        for name in ("cold", "from the compile cache"):
            measured = measure_with_cache(COMPILED_RUNS, cache)
            print_row((name, f"{measured['first'] - measured['again']:.2f}"))
        print()
        header = (
            "runs",
            "seconds",
            "us a run",
            "peak memory",
            "bytes a run",
            "seconds with the C code",
        )
        print_table(header, right_from=0)
        for runs in arguments.runs:
            measured, count = measure_with_cache(runs, cache), round(runs**0.5) ** 2
            seconds, peak = measured["run"], measured["peak"]
            growth = (peak - measured["before"]) * 2**20 / count
            times = f"{seconds:.2f}", f"{1e6 * seconds / count:.1f}"
            in_c = measure_with_cache(runs, cache, native=True)["run"]
            memory = f"{peak:.0f} MiB", f"{growth:.0f}"
            print_row((str(count), *times, *memory, f"{in_c:.2f}"))


if __name__ == "__main__":
    main()
