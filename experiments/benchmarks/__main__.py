"""All benchmarks, or those named, one after the other, each in its own process.

    python -m experiments.benchmarks [NAME ...] [--quick] [--list] [--pages]

Each prints its table; those that fail are named at the end, and the others still run. With --pages
what they print is written to `docs/_static/benchmarks`, too, which the pages of the site show.
`python -m experiments.benchmarks.NAME --help` prints the options of one benchmark.
"""

import datetime
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from experiments.benchmarks.common import parser

PAGES = Path(__file__).parents[2] / "docs" / "_static" / "benchmarks"


class Benchmark(NamedTuple):
    """Benchmark: what it compares, options for a short run, and options for the pages."""

    about: str
    quick: str = ""
    page: str = ""


BENCHMARKS = {
    "sweep": Benchmark("sweeps, derivatives: scipy, diffrax and numba", "--modes 3"),
    "cases": Benchmark(
        "one and two spans, loops, histories: scipy and diffrax", "--quick", "--modes 3"
    ),
    "first_answer": Benchmark("first answers of fresh processes: a script with scipy", "--quick"),
    "engine": Benchmark("first gradients, loops and sweeps of fresh processes", "'grad by mass'"),
    "trains": Benchmark("ten trains at many speeds: a script with numpy", "--speeds 5"),
    "vehicles": Benchmark("quarter cars: moving masses, and a script with scipy", "--runs 20"),
    "growth": Benchmark(
        "time and peak memory of growing sweeps; compiling",
        "--runs 4096 40000",
        "--runs 4096 40000 400000 2000000",
    ),
    "stored_runs": Benchmark(
        "ten million runs in a store: time, memory, disk", "--runs 40000 100000"
    ),
    "dimensions": Benchmark("samples, modes, loads and supports of a run, as they grow", "--quick"),
    "quadratic_programs": Benchmark("programs of predictive control: OSQP"),
    "environments": Benchmark("environments to learn in: a plain one in NumPy", "--batch 16"),
    "controller_steps": Benchmark("steps of controllers", "--only feedback"),
    "controller_code": Benchmark("C of controllers: operations, memory, agreement", "--only pd"),
    "profile": Benchmark("where the time of a sweep goes", "--modes 3"),
    "cluster": Benchmark("a sweep of a million runs on workers", "--runs 40000", "--runs 400000"),
}


def main() -> None:
    """Run benchmarks. Raises SystemExit if one fails, or for an unknown name."""
    options = parser(__doc__)
    options.add_argument(
        "names", nargs="*", metavar="NAME", help=f"{', '.join(BENCHMARKS)}; or all"
    )
    options.add_argument("--quick", action="store_true", help="short runs, to check that all work")
    options.add_argument("--list", action="store_true", help="only list the benchmarks")
    options.add_argument("--pages", action="store_true", help="write what is printed to the docs")
    arguments = options.parse_args()
    unknown = set(arguments.names) - set(BENCHMARKS)
    if unknown:
        message = f"{', '.join(sorted(unknown))}; there are {', '.join(BENCHMARKS)}"
        options.error(f"no benchmark {message}")
    failed = []
    for name in arguments.names or BENCHMARKS:
        about, quick, page = BENCHMARKS[name]
        if arguments.list:
            print(f"{name:18} {about}")
            continue
        print(f"\n## {name}: {about}\n", flush=True)
        command = [sys.executable, "-m", f"experiments.benchmarks.{name}"]
        command += (quick if arguments.quick else page if arguments.pages else "").split()
        pipe = subprocess.PIPE if arguments.pages else None
        ended = subprocess.run(command, stdout=pipe, text=True)
        if ended.returncode:
            failed.append(name)
        elif arguments.pages:
            print(ended.stdout)
            if "|" in ended.stdout:  # there is a table: the other solver is installed
                write_page(name, ended.stdout)
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


def write_page(name: str, printed: str) -> None:
    """Part of a page of the site: the output of a benchmark, with cores, load and date.

    The load is the mean number of processes that ran or waited in the last minute, the benchmark
    included: times are good where it is not above the number of cores. How long all took is left
    out.
    """
    PAGES.mkdir(exist_ok=True)
    day, load = datetime.date.today().isoformat(), os.getloadavg()[0]
    where = f"{os.cpu_count()} cores, load {load:.1f}, {day}:"
    text = re.sub(r"^took .*$", "", printed, flags=re.M).strip()
    (PAGES / f"{name}.md").write_text(f"{where}\n\n{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
