"""Sweeps of all kinds against scipy and diffrax: spans, loops, peaks and histories, modes.

    python -m experiments.benchmarks.cases [--spans 1 2] [--loops open sampled] [--modes 3 6 12]

Masses by speeds cross a pinned beam of one span, or of two. A patch on each span is commanded by
-gain times the deflection at its own sensor: in a sampled loop every 10 ms, in an instant loop
continuously. Each kind of sweep is measured in its own process: wall time (median of three) with
compiling apart, and peak memory. Then the largest error, of peaks relative to each, of histories
relative to the largest deflection of each run, against DOP853 with a strict tolerance at some
masses and speeds.

scipy is DOP853 in a loop with the tolerance at which its peaks are right to one part in a million,
timed on some runs and scaled; for peaks it stops half a second after the exit. diffrax has all
masses of a speed on shared steps, and is timed for peaks without a controller. jaxbeam computes
by XLA, without its C code.
"""

import argparse
import itertools
import json
import time

import numpy as np

import jaxbeam as jb
from experiments.benchmarks.common import (
    FASTEST,
    SLOWEST,
    measure_in_subprocess,
    parser,
    peak_memory,
    print_row,
    print_table,
    time_call,
    without_native,
)
from experiments.benchmarks.rivals import baselines
from experiments.benchmarks.rivals.baselines import MOMENT, PATCH, SPAN, PinnedBeam
from experiments.benchmarks.sweep import TOLERANCE

LOOPS = {"open": None, "sampled": 0.01, "instant": None}  # s between two commands
GAIN = 1e3  # V/m
SENSORS = {1: (0.3, 0.15, 0.45), 2: (0.3, 0.9, 0.15)}  # m; sensor i is fed back to patch i
SAMPLE_RATE = 100.0  # Hz, of histories and of the record of a loop
SCIPY_RUNS = 6  # timed runs, from which the time of scipy is scaled


def pinned_beam(spans: int, loop: str, modes: int) -> PinnedBeam:
    """The beam of the baselines."""
    gain = None if loop == "open" else GAIN
    return PinnedBeam(modes, SPAN * spans, sensors=SENSORS[spans], spans=spans, gain=gain,
               period=LOOPS[loop])  # fmt: skip


def jaxbeam_case(pinned: PinnedBeam) -> jb.Case:
    """The same beam as a case, with a duration for the slowest crossing."""
    beam = jb.Beam(
        length=pinned.length,
        flexural_rigidity=pinned.flexural_rigidity,
        mass_per_length=pinned.mass_per_length,
        damping_ratio=pinned.damping_ratio,
        modes=pinned.modes,
    )
    parts = {}
    if pinned.gain is not None:
        starts = SPAN * np.arange(pinned.spans)
        parts["actuators"] = [
            jb.Patch(
                start=start + PATCH[0],
                end=start + PATCH[1],
                moment_per_volt=MOMENT,
                depolarisation=[-1e9, 1e9],  # never reached
            )
            for start in starts
        ]
        parts["controller"] = jb.Feedback(gains=[pinned.gain] * pinned.spans, period=pinned.period)
    return jb.Case(
        beam,
        supports=[jb.Support(SPAN)] if pinned.spans == 2 else [],
        sensors=[jb.Sensor(x) for x in pinned.sensors],
        loads=[jb.MovingMass(mass=0.5, speed=1.0)],
        run=jb.Run(
            duration=pinned.length / SLOWEST + baselines.FREE_VIBRATION, sample_rate=SAMPLE_RATE
        ),
        **parts,
    )


def measure(spans: int, loop: str, saved: str, modes: int, side: int) -> dict[str, float]:
    """Wall times (s), memory (MiB) and errors of one kind of sweep of `side` by `side` runs.

    `loop` is a key of LOOPS, `saved` "peaks" or "histories". Times of other solvers are ratios to
    jaxbeam.
    """
    beam, histories = pinned_beam(spans, loop, modes), saved == "histories"
    masses, speeds = np.linspace(0.1, 1.0, side), np.linspace(SLOWEST, FASTEST, side)
    over, case = {"loads.0.mass": masses, "loads.0.speed": speeds}, jaxbeam_case(beam)

    def by_jaxbeam():
        options = {"progress": False, "tolerance": TOLERANCE, "histories": histories}
        with without_native():
            return jb.sweep(case, over, **options)

    timing = time_call(by_jaxbeam, repeat=3)
    memory, results = peak_memory(), by_jaxbeam()
    checked = np.ix_(*[np.unique(np.linspace(0, side - 1, 4).astype(int))] * 2)
    chosen = masses[checked[0].ravel()], speeds[checked[1].ravel()]
    times = results.time.values if histories else None

    def by_scipy(beam, masses, speeds, **tolerance):
        if histories:
            return baselines.scipy_histories(beam, masses, speeds, times, **tolerance)
        return baselines.scipy_peaks(beam, masses, speeds)

    def largest_error(values):
        return float(np.max(np.abs(values - reference) / size))

    if histories:
        reference = by_scipy(beam, *chosen, tolerance=baselines.REFERENCE_TOLERANCE)
        size = np.max(np.abs(reference), axis=(2, 3), keepdims=True)
        error = largest_error(results.deflection.values[checked])
    else:
        size = reference = baselines.reference_peaks(beam, *chosen)
        error = largest_error(results.peak_deflection.values[checked])
    scaled = baselines.scipy_time(by_scipy, beam, masses, speeds, SCIPY_RUNS, 1, by_jaxbeam)
    row = {
        "run": timing.run,
        "compile": timing.compile,
        "memory": memory,
        "error": error,
        "scipy": scaled.ratio,
        "scipy_error": largest_error(by_scipy(beam, *chosen)),
    }
    if loop == "open" and not histories:

        def by_diffrax():
            return baselines.diffrax_peaks(beam, masses, speeds, shared_steps=True)

        row["diffrax"] = time_call(by_diffrax, repeat=1, reference=by_jaxbeam).ratio
        row["diffrax_error"] = largest_error(np.asarray(by_diffrax())[checked])
    return row


def main() -> None:
    """Measure the selected kinds of sweeps and print the table."""
    saved_kinds = ["peaks", "histories"]
    options = parser(__doc__, modes=[3, 6, 12])
    options.add_argument("--spans", type=int, nargs="+", choices=[1, 2], default=[1, 2])
    options.add_argument("--loops", nargs="+", choices=list(LOOPS), default=["open", "sampled"])
    options.add_argument("--keep", nargs="+", choices=saved_kinds, default=saved_kinds)
    options.add_argument("--side", type=int, default=64, help="number of masses, and of speeds")
    options.add_argument("--quick", action="store_true", help="3 modes, 8 by 8")
    options.add_argument("--measure", nargs=5, help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.measure:
        spans, loop, saved, modes, side = arguments.measure
        print(json.dumps(measure(int(spans), loop, saved, int(modes), int(side))))
        return
    if arguments.quick:
        arguments.modes, arguments.side = [3], 8
    began = time.perf_counter()
    print(
        f"{arguments.side**2} crossings; scipy and diffrax in times jaxbeam's, errors in brackets\n"
    )
    columns = "jaxbeam", "compiling", "peak MiB", "scipy", "diffrax"
    print_table(("sweep", "modes", *columns))
    for kind in itertools.product(
        arguments.spans, arguments.loops, arguments.keep, arguments.modes
    ):
        row = measure_in_subprocess("experiments.benchmarks.cases", *kind, arguments.side)
        others = [
            f"{_three_digits(row[name])} ({row[name + '_error']:.0e})" if name in row else ""
            for name in ("scipy", "diffrax")
        ]
        times = f"{row['run']:.3g} s ({row['error']:.0e})", f"{row['compile']:.1f} s"
        spans, loop, saved, modes = kind
        name = f"{'one span' if spans == 1 else 'two spans'}, {loop}, {saved}"
        print_row((name, str(modes), *times, f"{row['memory']:.0f}", *others))
    print(f"\ntook {time.perf_counter() - began:.0f} s in all")


def _three_digits(x: float) -> str:
    return f"{x:.3g}" if x < 1000 else f"{x:.0f}"


if __name__ == "__main__":
    main()
