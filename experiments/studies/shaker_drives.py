"""Shaker of rig A driven by voltage, current or force: the effect of an inner loop.

The thesis finds that the force of the shaker follows the voltage up to some 10 Hz only, and that a
feedback of its own might give a precise force above (section 2.2.2). Here the shaker of Table 2.3
is on the bare beam of rig A: `python -m experiments.studies.shaker_drives`.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np

import jaxbeam as jb
from experiments.thesis.cases import data_physics_v4
from jaxbeam import rigs
from jaxbeam.case.actuators.electrodynamic import AbstractInnerLoop
from jaxbeam.model.state_space import poles

FREQUENCIES = np.geomspace(1.0, 100.0, 600)  # Hz
TOLERANCE = 0.1  # of the force at 1 Hz, by which a precise force may differ
LOOPS: dict[str, AbstractInnerLoop | None] = {
    "voltage": None,
    "current, 2000 1/s": jb.actuators.CurrentLoop(bandwidth=2e3),
    "force, 2000 1/s": jb.actuators.ForceLoop(bandwidth=2e3),
    "force, 20000 1/s": jb.actuators.ForceLoop(bandwidth=2e4),
    "force, 2000 1/s, sensor of 50 Hz": jb.actuators.ForceLoop(
        bandwidth=2e3, sensor_bandwidth=314.0
    ),
}


class Drive(NamedTuple):
    """Force on the beam per command (N/V, N/A, 1), how far it is flat, and damping without command.

    `force` is that at 1 Hz, `precise_to` the frequency (Hz) up to which it stays within a tenth of
    that, `least` and `largest` its extremes up to 100 Hz over it; `damping` the damping ratio of
    the mode of least frequency, and `growth` the largest real part of a pole (1/s).
    """

    force: float
    precise_to: float
    least: float
    largest: float
    damping: float
    growth: float


def drive(loop: AbstractInnerLoop | None) -> Drive:
    """Numbers of the shaker under an inner loop, or by its voltage."""
    shaker = eqx.tree_at(
        lambda one: one.inner_loop, data_physics_v4(), loop, is_leaf=lambda leaf: leaf is None
    )
    case = jb.Case(rigs.load("A").beam, actuators=[shaker])
    pair = [("actuators.0", "actuators.0.transmitted_force")]
    force = np.abs(np.asarray(jb.frequency_response(case, FREQUENCIES, pair).values)[:, 0])
    shares = force / force[0]
    outside = np.flatnonzero(np.abs(shares - 1) > TOLERANCE)
    found = poles(case)
    first = min(found[found.imag > 1], key=lambda pole: (abs(pole), pole.real), default=np.nan)
    return Drive(
        force=float(force[0]),
        precise_to=float(FREQUENCIES[outside[0]] if outside.size else FREQUENCIES[-1]),
        least=float(shares.min()),
        largest=float(shares.max()),
        damping=float(-first.real / abs(first)),
        growth=float(found.real.max()),
    )


def table() -> str:
    """Numbers of all drives, a row each."""
    head = f"{'drive':34}{'N per command':>14}{'flat to Hz':>11}{'least':>8}{'largest':>9}"
    rows = [f"{head}{'damping':>9}{'growth 1/s':>12}"]
    for name, loop in LOOPS.items():
        d = drive(loop)
        rows.append(
            f"{name:34}{d.force:14.3f}{d.precise_to:11.1f}{d.least:8.3f}{d.largest:9.2f}"
            f"{d.damping:9.3f}{d.growth:12.2f}"
        )
    return "\n".join(rows)


if __name__ == "__main__":
    print(table())
