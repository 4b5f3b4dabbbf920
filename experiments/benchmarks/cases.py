"""Sweeps of all kinds against scipy and diffrax: spans, loops, peaks and histories, modes.

    python -m experiments.benchmarks.cases [--spans 1 2] [--loops open sampled] [--modes 3 6 12]

Masses by speeds cross the pinned rig of one span, or of two; in a sampled loop a patch on each span
answers the deflection beside it every 10 ms, in an instant loop at every instant. Each kind of
sweep is measured in a process of its own: the time of a run (median of three) with compiling apart,
and the most memory that process has held until then. Then the largest error, of peaks relative to
each, of histories relative to the largest deflection of each run, against strict solutions by
DOP853 at some masses and speeds. scipy is DOP853 in a loop with the tolerance at which its peaks
are right to one part in a million, timed on some runs and scaled; it stops half a second after the
exit where peaks are wanted. diffrax has all masses of a speed on shared steps, and is timed where
no controller acts and peaks are wanted.
"""

import argparse
import itertools
import json
import subprocess
import sys
import time

import numpy as np

import jaxbeam as jb
from experiments.benchmarks.rivals import baselines
from experiments.benchmarks.rivals.pinned_beam import MOMENT, PATCH, SPAN, PinnedBeam
from experiments.benchmarks.sweep import TOLERANCE
from experiments.benchmarks.timing import peak_memory, time_call

LOOPS = {"open": None, "sampled": 0.01, "instant": None}  # s between two commands
GAIN = 1e3  # V/m
SENSORS = {1: (0.3, 0.15, 0.45), 2: (0.3, 0.9, 0.15)}  # m; each patch hears that of its number
SLOWEST, FASTEST = 0.3, 10.0  # m/s
SAMPLE_RATE = 100.0  # Hz, of histories and of the record of a loop
SCIPY_RUNS = 6  # runs by scipy from which its time is scaled


def pinned_beam(spans: int, loop: str, modes: int) -> PinnedBeam:
    """The rig as the baselines take it."""
    gain = None if loop == "open" else GAIN
    return PinnedBeam(modes, SPAN * spans, sensors=SENSORS[spans], spans=spans, gain=gain,
               period=LOOPS[loop])  # fmt: skip


def jaxbeam_case(pinned: PinnedBeam) -> jb.Case:
    """The same rig as jaxbeam takes it, long enough for the slowest crossing."""
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
                depolarisation=[-1e9, 1e9],  # of no concern: commands are in volts at the patch
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
    """Times (s; of others in ours), memory (MiB), errors of a kind of sweep, `side` by `side`."""
    beam, histories = pinned_beam(spans, loop, modes), saved == "histories"
    masses, speeds = np.linspace(0.1, 1.0, side), np.linspace(SLOWEST, FASTEST, side)
    over, base_case = {"loads.0.mass": masses, "loads.0.speed": speeds}, jaxbeam_case(beam)

    def ours():
        options = {"progress": False, "tolerance": TOLERANCE, "histories": histories}
        return jb.sweep(base_case, over, **options)

    took = time_call(ours, repeat=3)
    memory, found = peak_memory(), ours()
    checked = np.ix_(*[np.unique(np.linspace(0, side - 1, 4).astype(int))] * 2)
    chosen = masses[checked[0].ravel()], speeds[checked[1].ravel()]
    times = found.time.values if histories else None

    def solve(rig, masses, speeds, **tolerance):
        if histories:
            return baselines.scipy_histories(rig, masses, speeds, times, **tolerance)
        return baselines.scipy_peaks(rig, masses, speeds)

    def worst(values):
        return float(np.max(np.abs(values - reference) / size))

    if histories:
        reference = solve(beam, *chosen, tolerance=baselines.REFERENCE_TOLERANCE)
        size = np.max(np.abs(reference), axis=(2, 3), keepdims=True)
        error = worst(found.deflection.values[checked])
    else:
        size = reference = baselines.reference_peaks(beam, *chosen)
        error = worst(found.peak_deflection.values[checked])
    scaled = baselines.scipy_time(solve, beam, masses, speeds, SCIPY_RUNS, 1, ours)
    row = {
        "run": took.run,
        "compile": took.compile,
        "memory": memory,
        "error": error,
        "scipy": scaled.ratio,
        "scipy_error": worst(solve(beam, *chosen)),
    }
    if loop == "open" and not histories:

        def others():
            return baselines.diffrax_peaks(beam, masses, speeds, shared_steps=True)

        row["diffrax"] = time_call(others, repeat=1, reference=ours).ratio
        row["diffrax_error"] = worst(np.asarray(others())[checked])
    return row


def measure_in_subprocess(*kind) -> dict[str, float]:
    """The same, measured in a process of its own."""
    command = [sys.executable, "-m", "experiments.benchmarks.cases", "--measure", *map(str, kind)]
    found = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(found.stdout.splitlines()[-1])


def main() -> None:
    """Measure all kinds of sweep that are asked for and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--spans", type=int, nargs="+", choices=[1, 2], default=[1, 2])
    parser.add_argument("--loops", nargs="+", choices=list(LOOPS), default=["open", "sampled"])
    parser.add_argument(
        "--keep", nargs="+", choices=["peaks", "histories"], default=["peaks", "histories"]
    )
    parser.add_argument("--modes", type=int, nargs="+", default=[3, 6, 12])
    parser.add_argument("--side", type=int, default=64, help="masses, and speeds")
    parser.add_argument("--quick", action="store_true", help="3 modes, 8 by 8")
    parser.add_argument("--measure", nargs=5, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measure:
        spans, loop, kept, modes, side = given.measure
        print(json.dumps(measure(int(spans), loop, kept, int(modes), int(side))))
        return
    if given.quick:
        given.modes, given.side = [3], 8
    began = time.perf_counter()
    print(f"{given.side**2} crossings; scipy and diffrax in times jaxbeam's, errors behind\n")
    print("| spans | loop | kept | modes | jaxbeam | error | compiling | peak MiB"
          " | scipy | diffrax |")  # fmt: skip
    print("| ---: | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for kind in itertools.product(given.spans, given.loops, given.keep, given.modes):
        row = measure_in_subprocess(*kind, given.side)
        rivals = [
            f"{row[name]:.3g} ({row[name + '_error']:.0e})" if name in row else ""
            for name in ("scipy", "diffrax")
        ]
        print(f"| {' | '.join(map(str, kind))} | {row['run']:.3g} s | {row['error']:.0e} |"
              f" {row['compile']:.1f} s | {row['memory']:.0f} | {' | '.join(rivals)} |",
              flush=True)  # fmt: skip
    print(f"\ntook {time.perf_counter() - began:.0f} s in all")


if __name__ == "__main__":
    main()
