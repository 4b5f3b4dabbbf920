"""Sweeps of quarter cars, beside moving masses and a script with scipy.

    python -m experiments.benchmarks.vehicles [--runs 64]

64 body masses by 64 speeds on a bridge of 25 m, five modes; peaks of the deflection at midspan to
one part in a million. Quarter cars and moving masses of the same weight take turns, with steps in
C, where there is a compiler, and with steps by XLA. The script integrates modes and quarter car by
DOP853 in one run after the other; it computes a few of the runs, and is scaled. All times are of
the processor, since other processes disturb those of the clock.
"""

import time
from unittest import mock

import numpy as np
from scipy.integrate import solve_ivp

import jaxbeam as jb
from experiments.benchmarks.common import parser, print_row, print_table
from jaxbeam.simulation.integrator import native_peaks

LENGTH, RIGIDITY, MASS, DAMPING, MODES = 25.0, 3.05e10, 15000.0, 0.01, 5
GRAVITY, DURATION, FREE = 9.81, 1.6, 0.3  # the script stops so long (s) after the exit
AXLE, SUSPENSION, DAMPER, TYRE, TYRE_DAMPER = 1200.0, 8e5, 2e4, 3.5e6, 1e4
TOLERANCE = 9e-7
SCRIPT_TOLERANCE = 1e-4  # of DOP853, whose peaks are then as accurate as those of jaxbeam
SAMPLES = 800  # of the script, with a parabola through the highest three
REPEATS = 5


def bridge(load: jb.MovingMass | jb.QuarterCar) -> jb.Case:
    """The bridge under a load."""
    beam = jb.Beam(LENGTH, RIGIDITY, MASS, DAMPING, modes=MODES)
    return jb.Case(beam, sensors=[jb.Sensor(LENGTH / 2)], loads=[load], run=jb.Run(DURATION))


def quarter_car() -> jb.QuarterCar:
    """The quarter car, whose body mass and speed are varied."""
    springs = dict(suspension_stiffness=SUSPENSION, tyre_stiffness=TYRE)
    dampers = dict(suspension_damping=DAMPER, tyre_damping=TYRE_DAMPER)
    return jb.QuarterCar(speed=30.0, body_mass=16000.0, axle_mass=AXLE, **springs, **dampers)


def peaks(load: str, masses, speeds) -> np.ndarray:
    """Peaks (mass, speed) in m by `jaxbeam.sweep`, for body masses (kg) of quarter cars.

    Or for masses of the same weight.
    """
    if load == "quarter car":
        case, over = bridge(quarter_car()), {"loads.0.body_mass": masses}
    else:
        case, over = bridge(jb.MovingMass(mass=1.0, speed=30.0)), {"loads.0.mass": masses + AXLE}
    over["loads.0.speed"] = speeds
    return jb.sweep(case, over, tolerance=TOLERANCE, progress=False).peak_deflection.values[..., 0]


def script_peak(body: float, speed: float, tolerance: float = SCRIPT_TOLERANCE) -> float:
    """Peak (m) under a quarter car by scipy."""
    waves = np.arange(1, MODES + 1) * np.pi / LENGTH
    omega, norm = waves**2 * np.sqrt(RIGIDITY / MASS), np.sqrt(2 / (MASS * LENGTH))
    weight, leave = (body + AXLE) * GRAVITY, LENGTH / speed

    def rates(t, state):
        q, rate = state[:MODES], state[MODES : 2 * MODES]
        u, axle, du, daxle = state[2 * MODES :]
        x = speed * t
        shape = norm * np.sin(waves * x)
        height = shape @ q
        height_rate = shape @ rate + speed * norm * (waves * np.cos(waves * x)) @ q
        tyre = TYRE * (height - axle) + TYRE_DAMPER * (height_rate - daxle)
        spring = SUSPENSION * (axle - u) + DAMPER * (daxle - du)
        push = -shape * (weight + tyre)
        modal = push - 2 * DAMPING * omega * rate - omega**2 * q
        return np.concatenate([rate, modal, [du, daxle, spring / body, (tyre - spring) / AXLE]])

    def free_rates(_, state):
        q, rate = state[:MODES], state[MODES:]
        return np.concatenate([rate, -2 * DAMPING * omega * rate - omega**2 * q])

    options = dict(method="DOP853", rtol=tolerance, atol=tolerance * 1e-2, dense_output=True)
    crossing = solve_ivp(rates, (0.0, leave), np.zeros(2 * MODES + 4), **options)
    after = solve_ivp(free_rates, (leave, leave + FREE), crossing.y[: 2 * MODES, -1], **options)
    midspan, found = norm * np.sin(waves * LENGTH / 2), 0.0
    for part in (crossing, after):
        times = np.linspace(part.t[0], part.t[-1], SAMPLES)
        w = np.abs(midspan @ part.sol(times)[:MODES])
        i = int(np.argmax(w))
        found = max(found, w[i])
        if 0 < i < SAMPLES - 1:
            before, at, behind = w[i - 1 : i + 2]
            found = max(found, at + (before - behind) ** 2 / (8 * (2 * at - before - behind)))
    return found


def seconds(function, *args) -> float:
    """Processor time of a call."""
    start = time.process_time()
    function(*args)
    return time.process_time() - start


def measure(count: int, scripted: int = 8) -> dict[str, float]:
    """Processor times (s) by what is swept and how; and largest relative errors of peaks."""
    masses, speeds = np.linspace(1e4, 2e4, count), np.linspace(20.0, 60.0, count)
    found = {}
    for steps in ("C", "XLA"):
        if steps == "C" and not native_peaks.chosen_for(bridge(quarter_car()), count**2):
            continue
        with mock.patch.object(native_peaks, "chosen_for", lambda *_, steps=steps: steps == "C"):
            times = {"mass": [], "quarter car": []}
            for load in times:
                peaks(load, masses, speeds)  # compiles
            for _ in range(REPEATS):
                for load, taken in times.items():
                    taken.append(seconds(peaks, load, masses, speeds))
            found |= {f"{load}, {steps}": float(np.median(t)) for load, t in times.items()}
    pairs = [
        (masses[i * 7 % count], speeds[j])
        for i, j in enumerate(np.linspace(0, count - 1, scripted).round().astype(int))
    ]
    by_script = []
    found["script"] = seconds(lambda: by_script.extend(script_peak(*pair) for pair in pairs))
    found["script"] *= count**2 / scripted
    exact = np.array([script_peak(*pair, tolerance=1e-12) for pair in pairs])
    swept = np.array(
        [peaks("quarter car", masses[masses == m], speeds[speeds == v])[0, 0] for m, v in pairs]
    )
    found["error of the script"] = float(np.max(np.abs(by_script / exact - 1)))
    found["error of jaxbeam"] = float(np.max(np.abs(swept / exact - 1)))
    return found


def main() -> None:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("--runs", type=int, default=64, help="numbers of masses, and of speeds")
    count = options.parse_args().runs
    found = measure(count)
    print(f"{count**2} crossings, 5 modes\n")
    print_table(["", "processor (s)", "times masses", "script over it"])
    for steps in ("C", "XLA"):
        if f"mass, {steps}" not in found:
            continue
        mass, car = (found[f"{load}, {steps}"] for load in ("mass", "quarter car"))
        print_row([f"masses, {steps}", f"{mass:.3g}", "", ""])
        ratios = f"{car / mass:.2g}", f"{found['script'] / car:.0f}"
        print_row([f"quarter cars, {steps}", f"{car:.3g}", *ratios])
    print_row(["the script, scaled", f"{found['script']:.0f}", "", ""])
    errors = (f"{name} {found[name]:.1e}" for name in ("error of the script", "error of jaxbeam"))
    print(f"\n{', '.join(errors)}")


if __name__ == "__main__":
    main()
