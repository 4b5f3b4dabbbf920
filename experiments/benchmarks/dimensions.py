"""Time and memory of single runs as each dimension grows: samples, modes, loads, supports.

    python -m experiments.benchmarks.dimensions [--quick]

Moving masses on a beam, one dimension at a time, each size in a process of its own; runs of a sweep
are in `growth` and `stored_runs`. Seconds are of the processor; memory is the most that a run takes
at once, as traced by Python in another process, since what a process had before hides what it needs
again. In the columns "over proportional" time and memory are divided by those of the smallest size,
and by the ratio of the sizes: 1 where they are proportional. Frequencies grow with the square of
the number of modes, and so does the number of steps, of which all states are kept: time and memory
are per step there. A beam of many supports has a mode a span at least, too.
"""

import argparse
import json
import time
import tracemalloc
import warnings

import numpy as np

import jaxbeam as jb
from experiments.benchmarks.common import measure_in_subprocess, parser, print_row, print_table
from jaxbeam.simulation.simulate import ContactLossWarning

SIZES = {
    "samples": (10_000, 100_000, 1_000_000),
    "modes": (25, 50, 100, 200),
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


def measure(quantity: str, dimension: str, size: int) -> dict[str, float]:
    """Processor time (s) and steps of a run, or its peak memory (MiB)."""
    case = sized_case(**BASE | {dimension: size})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        jb.simulate(sized_case(**BASE))  # imports
        if quantity == "memory":
            tracemalloc.start()
            jb.simulate(case)
            return {"memory": tracemalloc.get_traced_memory()[1] / 2**20}
        start = time.process_time()
        record = jb.simulate(case)
        return {"run": time.process_time() - start, "steps": record.steps}


def main() -> None:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("--quick", action="store_true", help="the smallest size of each")
    options.add_argument("--measure", nargs=3, help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.measure is not None:
        quantity, dimension, size = arguments.measure
        print(json.dumps(measure(quantity, dimension, int(size))))
        return
    header = "dimension", "size", "steps", "seconds", "us a step", "over proportional"
    print_table((*header, "MiB", "over proportional"))
    for dimension, sizes in SIZES.items():
        first: tuple[float, float] | None = None
        for size in sizes[:1] if arguments.quick else sizes:
            module = "experiments.benchmarks.dimensions"
            found: dict[str, float] = {}
            for quantity in ("time", "memory"):
                found |= measure_in_subprocess(module, quantity, dimension, size)
            memory, a_step = found["memory"], 1e6 * found["run"] / found["steps"]
            # Samples are the steps of a run; modes shorten steps.
            amount = found["run"] if dimension == "samples" else a_step
            kept = memory / found["steps"] if dimension == "modes" else memory
            first = first or (amount, kept)
            grown = size / sizes[0]
            print_row(
                (
                    *(dimension, str(size), str(found["steps"])),
                    *(f"{found['run']:.2f}", f"{a_step:.0f}", f"{amount / first[0] / grown:.2f}"),
                    *(f"{memory:.0f}", f"{kept / first[1] / grown:.2f}"),
                )
            )


if __name__ == "__main__":
    main()
