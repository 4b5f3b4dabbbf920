"""Time and memory of single runs as each dimension grows: samples, modes, loads, supports.

    python -m experiments.benchmarks.dimensions [--quick]

Moving masses on a beam, one dimension at a time, each size in a process of its own; runs of a sweep
are in `growth`. The last column is the ratio of seconds to those of the size before, over the ratio
of the sizes: 1 where time is proportional.
"""

import argparse
import json
import time
import warnings

import numpy as np

import jaxbeam as jb
from experiments.benchmarks.common import (
    measure_in_subprocess,
    parser,
    peak_memory,
    print_row,
    print_table,
)
from jaxbeam.simulation.simulate import ContactLossWarning

SIZES = {
    "samples": (10_000, 100_000, 1_000_000),
    "modes": (50, 100, 200),
    "loads": (15, 30, 60),
    "supports": (7, 15, 30),
}
BASE = {"samples": 1000, "modes": 5, "loads": 1, "supports": 0}


def sized_case(samples: int, modes: int, loads: int, supports: int) -> jb.Case:
    """A beam of a metre a span, crossed by masses that follow each other within a third of it."""
    length = supports + 1.0
    modes = max(modes, supports + 1)
    speed, gap = 2.0, length / (3.0 * loads)
    duration = (length + loads * gap) / speed + 0.5
    return jb.Case(
        jb.Beam(length, 12.0, 0.5, damping_ratio=0.02, modes=modes),
        supports=[jb.Support(float(x)) for x in np.arange(1, supports + 1)],
        sensors=[jb.Sensor(0.37)],
        loads=[
            jb.MovingMass(mass=0.05, speed=speed, entry_time=i * gap / speed) for i in range(loads)
        ],
        run=jb.Run(duration, sample_rate=samples / duration),
    )


def measure(dimension: str, size: int) -> dict[str, float]:
    """Wall time (s) of a run, the peak memory (MiB) of the process, and that before the run."""
    case = sized_case(**BASE | {dimension: size})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        jb.simulate(sized_case(**BASE))  # imports
        before, start = peak_memory(), time.perf_counter()
        jb.simulate(case)
    return {"run": time.perf_counter() - start, "before": before, "peak": peak_memory()}


def main() -> None:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("--quick", action="store_true", help="the smallest size of each")
    options.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.measure is not None:
        dimension, size = arguments.measure
        print(json.dumps(measure(dimension, int(size))))
        return
    print_table(("dimension", "size", "seconds", "MiB", "seconds, over proportional"))
    for dimension, sizes in SIZES.items():
        former: tuple[int, float] | None = None
        for size in sizes[:1] if arguments.quick else sizes:
            module = "experiments.benchmarks.dimensions"
            found = measure_in_subprocess(module, dimension, size, environment={})
            seconds, memory = found["run"], found["peak"] - found["before"]
            ratio = "" if former is None else f"{seconds / former[1] / (size / former[0]):.2f}"
            print_row((dimension, str(size), f"{seconds:.2f}", f"{memory:.0f}", ratio))
            former = size, seconds


if __name__ == "__main__":
    main()
