"""Make the logs that `jaxbeam reproduce identification` fits: python -m tests.tuning.make_rig_logs

The published rigs with the parameters fitted by hand in the thesis, as finite elements with twelve
modes, integrated by scipy: crossed by the heaviest load while their actuators are driven by sine
sweeps, with white noise in the readings. No response is computed by jaxbeam.
"""

from pathlib import Path

import numpy as np
import scipy.signal

import jaxbeam as jb
from experiments.thesis.chapter2.identification import HAND_FITTED, with_log_modes
from jaxbeam.case.library import rigs
from tests.oracles import finite_elements
from tests.tuning.finite_element_rigs import Plant

FOLDER = Path(__file__).parents[2] / "experiments" / "thesis" / "chapter2" / "logs"
RATE, NOISE, SEED, SPEED = 100.0, 1e-5, 3, 1.0  # Hz, m, -, m/s
VOLTS, LOWEST, HIGHEST = 2.0, 1.0, 30.0  # V, Hz, Hz


def plant(name: str) -> Plant:
    """A rig as finite elements."""
    case = jb.replace(with_log_modes(rigs.load(name)), HAND_FITTED[name] | {"loads.0.speed": SPEED})
    beam = case.beam
    suspensions = [
        finite_elements.Suspension(float(a.position), float(a.stiffness), float(a.damping))
        for a in case.actuators
        if isinstance(a, jb.Shaker)
    ]
    elements = finite_elements.Beam(
        float(beam.length),
        float(beam.flexural_rigidity),
        float(beam.mass_per_length),
        supports=[finite_elements.Support(float(s.position)) for s in case.supports],
        suspensions=suspensions,
        damping_ratio=float(beam.damping_ratio),
        elements=round(40 * float(beam.length)),
    )
    return Plant(elements, case, HAND_FITTED[name])


def make(name: str) -> np.ndarray:
    """A log: rows of time in s, readings in mm, commands in V."""
    rig = plant(name)
    duration = float(rig.case.beam.length) / SPEED + 0.4
    times = np.arange(round(duration * RATE) + 1) / RATE
    phases = 90.0 * np.arange(len(rig.case.actuators))
    sweeps = [scipy.signal.chirp(times, LOWEST, duration, HIGHEST, phi=phi) for phi in phases]
    commands = VOLTS * np.stack(sweeps, axis=1)
    readings = rig.readings(times, commands)
    readings = readings + NOISE * np.random.default_rng(SEED).normal(size=readings.shape)
    return np.column_stack([times, 1e3 * readings, commands])


def description(name: str) -> str:
    """Description of a log: its columns and loads."""
    case = rigs.load(name)
    lines = [f"# Rig {name} of finite elements, by tests/tuning/make_rig_logs.py"]
    for kind, letter, parts in (("sensor", "d", case.sensors), ("actuator", "u", case.actuators)):
        for i in range(len(parts)):
            lines += [f"[columns.{letter}{i + 1}]", f"{kind} = {i}"]
    mass = float(case.loads[0].mass)
    lines += ["[[loads]]", 'kind = "mass"', f"mass = {mass:g}  # kg", f"speed = {SPEED:g}  # m/s"]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write all logs."""
    for name in HAND_FITTED:
        case = rigs.load(name)
        names = [f"d{i + 1} [mm]" for i in range(len(case.sensors))]
        names += [f"u{i + 1} [V]" for i in range(len(case.actuators))]
        heading = ",".join(["time [s]", *names])
        path = FOLDER / f"{name}.csv"
        np.savetxt(path, make(name), fmt="%.5f", delimiter=",", header=heading, comments="")
        path.with_suffix(".toml").write_text(description(name), encoding="utf-8")


if __name__ == "__main__":
    main()
