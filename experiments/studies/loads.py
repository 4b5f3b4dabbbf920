"""Loads on the patch rigs B and C: those that laws are tuned on, and those held out.

Loads enter at sampling instants and between them.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

import jaxbeam as jb
import tuning
from tuning.control.load_cases import AddressValues

PERIOD = 0.01  # s, of sampling
MASSES, ENTRY_TIME = (0.261, 0.509), 0.05  # kg, s: training
HELD_OUT_MASSES = (0.322, 0.42)  # kg
HELD_OUT_SPEEDS = {"B": (0.35, 0.55, 0.95), "C": (0.45, 0.95)}  # m/s
HELD_OUT_ENTRY_TIME = 0.054  # s: between sampling instants, after the first command
FREE_VIBRATION = 0.1  # s after the slowest held-out crossing


def training_loads(
    speeds: Sequence[float] | np.ndarray, changes: Sequence[Mapping[str, float]] = ({},)
) -> tuple[AddressValues, ...]:
    """The lightest and the heaviest load at all speeds (m/s), as numbers by address.

    Each also with every one of the `changes` of the plant.
    """
    return tuple(
        {
            "loads.0.mass": mass,
            "loads.0.speed": float(speed),
            "loads.0.entry_time": ENTRY_TIME + PERIOD * ((2 * i + j) % 4) / 4,
        }
        | dict(change)
        for i, speed in enumerate(speeds)
        for j, mass in enumerate(MASSES)
        for change in changes
    )


def held_out_loads(rig: str) -> tuple[AddressValues, ...]:
    """Loads of rig B or C that no law is tuned on, as numbers by address."""
    return tuning.full_grid(
        {
            "loads.0.mass": HELD_OUT_MASSES,
            "loads.0.speed": HELD_OUT_SPEEDS[rig],
            "loads.0.entry_time": [HELD_OUT_ENTRY_TIME],
        }
    )


def with_held_out_duration(rig: str, case: jb.Case) -> jb.Case:
    """The case with a duration for the slowest of the held-out loads."""
    slowest = float(case.beam.length) / min(HELD_OUT_SPEEDS[rig])
    duration = slowest + HELD_OUT_ENTRY_TIME + FREE_VIBRATION
    return dataclasses.replace(case, run=jb.Run(duration=duration, sample_rate=200.0))
