"""Laws drawn by hand on the patch rigs: the yardstick beside which tuned laws are judged.

A trapezium of four numbers on the same gates as the tuned table, and the table over the deflection
that the tuning of the sensors-only law starts from. No number of them was fitted to any run.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
from experiments.studies.tune_feedforward import COMMAND_LIMITS, INITIAL_TABLES, initial_law

LOW, HIGH = COMMAND_LIMITS
TRAPEZIUM = ([0.0, 0.2, 0.9, 1.0], [0.0, HIGH, HIGH, 0.0])  # shares of the span, V
HAND_SET, HAND_DRAWN = "hand-set trapezium", "hand-drawn, sensors only"


def trapezium(rig: str) -> jb.Feedforward:
    """The trapezium at the limits of the patch of rig B; on rig C that which tuning starts from."""
    tables = [TRAPEZIUM] if rig == "B" else INITIAL_TABLES[rig]
    shares = np.unique(np.concatenate([shares for shares, _ in tables]))
    values = np.array([np.interp(shares, *table) for table in tables])
    return dataclasses.replace(initial_law(rig), shares=shares, values=values)
