"""Sweep of ten trains HSLM-A at many speeds, beside a script with numpy.

    python -m experiments.benchmarks.trains [--speeds 101]

A bridge of 25 m, five modes, damping 1 %; peaks of deflection, acceleration and moment at midspan,
with their truncation errors. The script knows the modes of the pinned beam, and propagates them
exactly for forces that are linear in time between samples 0.5 ms apart; it computes two of the
runs, and is scaled. Its modal sums have no static correction, so that moments are not compared.
Then HSLM-A1 with 161 sensors, and the assessment of a haunched bridge, each in a process of its own
with its peak memory.
"""

import argparse
import json
import time

import numpy as np

import jaxbeam as jb
from experiments.benchmarks.common import (
    measure_in_subprocess,
    parser,
    peak_memory,
    print_row,
    print_table,
)

LENGTH, RIGIDITY, MASS, DAMPING, MODES = 25.0, 3.05e10, 15000.0, 0.01, 5
DURATION, INTERVAL = 12.0, 5e-4  # s
TRAINS = tuple(f"HSLM-A{i}" for i in range(1, 11))
CHECKED = (("HSLM-A3", 60.0), ("HSLM-A8", 75.0))  # train and speed (m/s)
REPEATS = 3  # of which the shortest counts: other processes disturb it least
LARGEST_DIFFERENCE = 2e-3  # of peaks: the samples of the script miss some of the acceleration


def bridge() -> jb.Case:
    """The bridge with one of the trains."""
    return jb.Case(
        jb.Beam(LENGTH, RIGIDITY, MASS, DAMPING, modes=MODES),
        sensors=[jb.Sensor(LENGTH / 2, name) for name in ("deflection", "acceleration", "moment")],
        loads=[jb.Axles(train=TRAINS[0], speed=60.0)],
        run=jb.Run(DURATION),
    )


def sampled_peaks(train: str, speed: float) -> tuple[float, float]:
    """Largest deflection (m) and acceleration (m/s^2) at midspan among samples of the modes."""
    load = jb.Axles(train=train, speed=speed).by_numbers()
    offsets, forces = np.asarray(load.offsets), np.asarray(load.forces)
    times = np.arange(round(DURATION / INTERVAL) + 1) * INTERVAL
    x = speed * times[:, None] - offsets
    forces = np.where((x > 0) & (x < LENGTH), forces, 0.0)
    deflection, acceleration = np.zeros((2, times.size))
    for mode in range(1, MODES + 1):
        wavenumber = mode * np.pi / LENGTH
        omega = wavenumber**2 * np.sqrt(RIGIDITY / MASS)
        force = (forces * np.sin(wavenumber * x)).sum(axis=1) * 2 / (MASS * LENGTH)
        # q' = pole q + force / (pole - conjugate of pole), exactly for forces linear in time.
        pole = omega * (-DAMPING + 1j * np.sqrt(1 - DAMPING**2))
        growth = np.exp(pole * INTERVAL)
        end = (growth - 1 - pole * INTERVAL) / (pole**2 * INTERVAL)
        start = (growth - 1) / pole - end
        push = start * force[:-1] + end * force[1:]
        state, states = 0j, np.zeros(times.size, complex)
        for i in range(times.size - 1):
            state = growth * state + push[i]
            states[i + 1] = state
        amplitude = states.imag / pole.imag
        rate = (pole * states).imag / pole.imag
        at_midspan = np.sin(mode * np.pi / 2)
        deflection += at_midspan * amplitude
        acceleration += at_midspan * (force - 2 * DAMPING * omega * rate - omega**2 * amplitude)
    return float(np.abs(deflection).max()), float(np.abs(acceleration).max())


def measure(speeds: np.ndarray) -> dict[str, float]:
    """Seconds (wall and processor) of the sweep and, scaled, of the script; largest difference.

    Raises RuntimeError if their peaks differ.
    """
    case = bridge()
    jb.sweep(case, {"loads.0.speed": speeds[:2], "loads.0.train": ["HSLM-A1"]}, progress=False)
    times = []
    for _ in range(REPEATS):
        wall, processor = time.perf_counter(), time.process_time()
        jb.sweep(case, {"loads.0.train": TRAINS, "loads.0.speed": speeds}, progress=False)
        times.append((time.perf_counter() - wall, time.process_time() - processor))
    found = dict(zip(("wall", "processor"), min(times), strict=True))
    start, difference = time.process_time(), 0.0
    by_script = [sampled_peaks(*run) for run in CHECKED]
    found["script"] = (time.process_time() - start) / len(CHECKED) * len(TRAINS) * speeds.size
    for (train, speed), sampled in zip(CHECKED, by_script, strict=True):
        one = {"loads.0.train": [train], "loads.0.speed": [speed]}
        runs = jb.sweep(case, one, progress=False).isel({"loads.0.train": 0, "loads.0.speed": 0})
        peaks = runs.peak_deflection.max().item(), runs.peak_acceleration.max().item()
        difference = max(difference, np.abs(np.divide(sampled, peaks) - 1).max())
    if not difference < LARGEST_DIFFERENCE:
        raise RuntimeError(f"peaks of the script differ by {difference:.1e}")
    return found | {"difference": float(difference)}


def haunched_bridge() -> jb.Case:
    """Three spans of 40, 60 and 40 m, twice as stiff over the piers."""
    stiffness = [2.5e11, 5e11, 2.5e11, 5e11, 2.5e11]
    segments = [
        jb.Segment(length, [left, right - left], 18e3)
        for length, left, right in zip(
            [40.0, 30.0, 30.0, 40.0], stiffness[:-1], stiffness[1:], strict=True
        )
    ]
    beam = jb.Beam(140.0, damping_ratio=0.01, segments=segments)
    return jb.Case(beam, supports=[jb.Support(40.0), jb.Support(100.0)])


LARGE = ("161 deflections", "161 moments", "assessment")


def measure_large(name: str, count: int) -> dict[str, float]:
    """Processor seconds and peak memory (MiB) of one of the `LARGE` tasks at a number of speeds."""
    start = time.process_time()
    if name == "assessment":
        jb.assess(haunched_bridge(), 60.0, determinant_length=56.0, trains=TRAINS[:1], dynamic=True)
    else:
        quantity = name.split()[1].rstrip("s")
        x = np.linspace(0.0, LENGTH, 163)[1:-1]
        sensors = tuple(jb.Sensor(float(place), quantity) for place in x)
        case = jb.Case(bridge().beam, sensors=sensors, loads=bridge().loads, run=bridge().run)
        jb.sweep(case, {"loads.0.speed": np.linspace(40.0, 90.0, count)}, progress=False)
    return {"processor": time.process_time() - start, "memory": peak_memory()}


def main() -> None:
    """Print the tables."""
    options = parser(__doc__)
    options.add_argument("--speeds", type=int, default=101, help="number of speeds")
    options.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    arguments = options.parse_args()
    count = arguments.speeds
    if arguments.measure:
        name, speeds = arguments.measure
        print(json.dumps(measure_large(name, int(speeds))))
        return
    found = measure(np.linspace(40.0, 90.0, count))
    print(f"{len(TRAINS)} trains at {count} speeds\n")
    print_table(["", "wall (s)", "processor (s)"])
    print_row(["`jb.sweep`", f"{found['wall']:.2f}", f"{found['processor']:.2f}"])
    print_row(["the script, scaled", "", f"{found['script']:.0f}"])
    print(f"\nlargest difference of peaks: {found['difference']:.1e}\n")
    print_table([f"HSLM-A1 at {count} speeds", "processor (s)", "peak memory (MiB)"])
    for name in LARGE:
        one = measure_in_subprocess("experiments.benchmarks.trains", name, count)
        print_row([name, f"{one['processor']:.1f}", f"{one['memory']:.0f}"])


if __name__ == "__main__":
    main()
