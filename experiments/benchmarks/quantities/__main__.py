"""Sweeps of every quantity at midspan, beside one of deflections, with and without C.

    python -m experiments.benchmarks.quantities [--modes 3 12] [--runs 4096]

Masses by speeds on one span; peaks to the default tolerance, with their truncation errors. All
quantities are timed in turn, and the shortest time of each counts: they are a few hundredths of a
second.
"""

import dataclasses
import time
from unittest import mock

import numpy as np

import jaxbeam as jb
from experiments.benchmarks.common import (
    FASTEST,
    SLOWEST,
    one_span_case,
    parser,
    print_row,
    print_table,
)
from jaxbeam.integrator import native_peaks

QUANTITIES = ("deflection", "moment", "shear", "velocity", "acceleration")
REPEATS = 7


def shortest_times(modes: int, runs: int) -> list[float]:
    """Shortest wall times (s) of the sweeps of all quantities."""
    count = round(runs**0.5)
    over = {
        "loads.0.mass": np.linspace(0.1, 1.0, count),
        "loads.0.speed": np.linspace(SLOWEST, FASTEST, count),
    }
    plain = one_span_case(modes)
    midspan = plain.beam.length / 2
    cases = [dataclasses.replace(plain, sensors=(jb.Sensor(midspan, name),)) for name in QUANTITIES]
    times = np.full((REPEATS + 1, len(cases)), np.inf)
    for repeat in times:
        for i, case in enumerate(cases):
            start = time.perf_counter()
            jb.sweep(case, over, progress=False)
            repeat[i] = time.perf_counter() - start
    return list(times[1:].min(axis=0))  # the first compiles


def main() -> None:
    """Print the table."""
    options = parser(__doc__, modes=[3, 12])
    options.add_argument("--runs", type=int, default=4096)
    arguments = options.parse_args()
    print_table(("times deflection", *QUANTITIES))
    for modes in arguments.modes:
        for where, chosen in (("C", native_peaks.chosen_for), ("XLA", lambda case, runs: False)):
            with mock.patch.object(native_peaks, "chosen_for", chosen):
                times = shortest_times(modes, arguments.runs)
            ratios = [f"{one / times[0]:.2f}" for one in times[1:]]
            print_row((f"{modes} modes, {where}", f"{times[0]:.3f} s", *ratios))


if __name__ == "__main__":
    main()
