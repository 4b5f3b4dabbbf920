"""Time and peak memory of a sweep as it grows, and what compiling it takes.

    python -m experiments.benchmarks.growth [--runs 4096 40000 400000 4000000]

Masses by speeds of the one-span rig with three modes, peaks at three sensors. Every size is swept
in a process of its own, whose peak memory is told by the operating system, so that no size hides in
what another took; all is compiled before, by a sweep of 64 by 64 and one of all masses and a few of
the speeds. The first is timed in two processes that share a new persistent cache: one compiles, the
other reads.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time

COMPILED_RUNS = 4096  # runs of the sweep by which everything is compiled


def measure(runs: int) -> dict[str, float]:
    """Seconds of the first sweep and of one of so many runs, and MiB before and at the peak.

    Raises RuntimeError if a run fails.
    """
    import xarray

    from experiments.benchmarks.cluster import grid
    from experiments.benchmarks.sweep import one_span_case
    from experiments.benchmarks.timing import peak_memory
    from jaxbeam.sweeps.sweep import sweep

    case, took, over = one_span_case(3), [], grid(runs)
    xarray.Dataset({"loaded": ("run", [0.0])})
    # Blocks depend on how many masses there are: with all of them, some speeds compile all.
    some = over | {"loads.0.speed": over["loads.0.speed"][:: -(-len(over["loads.0.speed"]) // 16)]}
    before = 0.0
    for given in (grid(COMPILED_RUNS), grid(COMPILED_RUNS), some, over):
        before = peak_memory()
        start = time.perf_counter()
        found = sweep(case, given, progress=False)
        took.append(time.perf_counter() - start)
        if found.failed.any():
            raise RuntimeError(f"{int(found.failed.sum())} runs failed")
    peak = peak_memory()
    return {"first": took[0], "again": took[1], "run": took[3], "before": before, "peak": peak}


def measure_in_subprocess(runs: int, cache: str) -> dict[str, float]:
    """The same, measured in a process of its own with a persistent cache in a folder."""
    settings = {
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    command = [sys.executable, "-m", "experiments.benchmarks.growth", "--measure", str(runs)]
    found = subprocess.run(
        command, env=os.environ | settings, check=True, stdout=subprocess.PIPE, text=True
    )
    return json.loads(found.stdout.splitlines()[-1])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, nargs="+", default=[4096, 40_000, 400_000, 4_000_000])
    parser.add_argument("--measure", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measure is not None:
        print(json.dumps(measure(given.measure)))
        return
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = (
            measure_in_subprocess(COMPILED_RUNS, cache),
            measure_in_subprocess(COMPILED_RUNS, cache),
        )
        print("| compiling a sweep | seconds |\n| --- | ---: |")
        for name, found in {"cold": cold, "from the persistent cache": warm}.items():
            print(f"| {name} | {found['first'] - found['again']:.2f} |", flush=True)
        print("\n| runs | seconds | us a run | peak MiB | bytes a run above what was held before |")
        print("| ---: | ---: | ---: | ---: | ---: |")
        for runs in given.runs:
            found, count = measure_in_subprocess(runs, cache), round(runs**0.5) ** 2
            more = (found["peak"] - found["before"]) * 2**20 / count
            print(
                f"| {count} | {found['run']:.2f} | {1e6 * found['run'] / count:.1f} |"
                f" {found['peak']:.0f} | {more:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
