"""Laws drawn by hand on the patch rigs: the yardstick beside which tuned laws are judged.

A trapezium of four numbers on the same gates as the tuned table, and the table over the deflection
that the tuning of the sensors-only law starts from. No number of them was fitted to any run.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
from experiments.studies.tune_feedforward import COMMAND_LIMITS, initial_law

LOW, HIGH = COMMAND_LIMITS
TRAPEZIA = {  # shares of the beam, V: from limit to limit, with ramps drawn by hand
    "B": [([0.0, 0.2, 0.9, 1.0], [0.0, HIGH, HIGH, 0.0])],
    "C": [
        ([0.0, 0.1, 0.38, 0.55, 0.75, 1.0], [0.0, HIGH, HIGH, LOW, LOW, 0.0]),
        ([0.0, 0.1, 0.38, 0.55, 0.9, 1.0], [0.0, LOW, LOW, HIGH, HIGH, 0.0]),
    ],
}
HAND_SET, HAND_DRAWN = "hand-set trapezium", "hand-drawn, sensors only"


def trapezium(rig: str) -> jb.Feedforward:
    """The law drawn by hand on the gates, with the lead of the law that tuning starts from."""
    tables = TRAPEZIA[rig]
    shares = np.unique(np.concatenate([shares for shares, _ in tables]))
    values = np.array([np.interp(shares, *table) for table in tables])
    return dataclasses.replace(initial_law(rig), shares=shares, values=values)
