"""Laws drawn by hand on the patch rigs, the reference for tuned laws.

A trapezium of four numbers on the same gates as the tuned table, and a table over the deflection
that goes to the limits where the tuning of the sensors-only law starts to be flat. No number of
them was fitted to any run.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
from experiments.studies import tune_sensor_feedback
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


def drawn_table(rig: str) -> jb.InternalModel:
    """The law drawn by hand over the sensors' readings: straight to the limits, then flat."""
    law = tune_sensor_feedback.initial_law(rig)
    flat_from, _, above = tune_sensor_feedback.INITIAL_TABLE[rig]  # m, -, V
    ends = [HIGH, 0.0, LOW if above else 0.0]  # one span is not pressed down by its patch
    row = np.interp(np.asarray(law.readings), [-flat_from, 0.0, flat_from], ends)
    return dataclasses.replace(law, values=np.array([row] * law.values.shape[0]))
