"""All benchmarks, or those named, one after the other, each in a process of its own.

    python -m experiments.benchmarks [NAME ...] [--quick] [--list]

Each prints its table; one that fails is named at the end, and the others still run. What a single
one takes as options, `python -m experiments.benchmarks.NAME --help` says.
"""

import argparse
import subprocess
import sys
from typing import NamedTuple


class Benchmark(NamedTuple):
    """What a benchmark compares, and the options that make it short."""

    about: str
    quick: str = ""


BENCHMARKS = {
    "sweep": Benchmark("sweeps, derivatives: scipy, diffrax and numba", "--modes 3"),
    "cases": Benchmark("one and two spans, loops, histories: scipy and diffrax", "--quick"),
    "kernel": Benchmark("sweeps: the same method by hand in C", "--modes 3"),
    "growth": Benchmark("time and peak memory of growing sweeps; compiling", "--runs 4096 40000"),
    "identify": Benchmark("identification: scipy's least squares"),
    "riccati": Benchmark("designs of regulators, many at once"),
    "quadratic": Benchmark("programs of predictive control: OSQP"),
    "steps": Benchmark("steps of controllers", "--only feedback"),
    "tuners": Benchmark("tuning by gradients, beside differential evolution"),
    "profile": Benchmark("where the time of a sweep goes"),
    "cluster": Benchmark("a sweep of a million runs on workers", "--runs 40000"),
}


def main() -> None:
    """Run benchmarks. Raises SystemExit if one fails, or has no such name."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(BENCHMARKS)}; or all")
    parser.add_argument("--quick", action="store_true", help="in short, to see that all work")
    parser.add_argument("--list", action="store_true", help="only say which there are")
    given = parser.parse_args()
    unknown = set(given.names) - set(BENCHMARKS)
    if unknown:
        some = f"{', '.join(sorted(unknown))}; there are {', '.join(BENCHMARKS)}"
        parser.error(f"no benchmark {some}")
    failed = []
    for name in given.names or BENCHMARKS:
        about, quick = BENCHMARKS[name]
        if given.list:
            print(f"{name:10} {about}")
            continue
        print(f"\n## {name}: {about}\n", flush=True)
        command = [sys.executable, "-m", f"experiments.benchmarks.{name}"]
        if subprocess.run(command + (quick.split() if given.quick else [])).returncode:
            failed.append(name)
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
