"""Tune the feedforward tables of `experiments.studies.tuned_feedforward` by gradients.

    python -m experiments.studies.tune_feedforward B    # or C

writes controllers/feedforward/B.toml. On each patch rig one table of commands over the position of
the load serves all masses and speeds. It starts as a trapezium within the limits of the patches;
its values follow the gradient of the worst shortfall from the least achievable peak. On the bench
the same table is read earlier by the delay.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

import jaxbeam as jb
import tuning
from experiments.studies.held_out import PERIOD, training_loads
from experiments.thesis.cases import with_modes
from jaxbeam import rigs

FOLDER = Path(__file__).parent / "controllers" / "feedforward"
LEAD = 0.005  # s: half of the sampling period, the mean delay of a held command
GATES = (-0.2, -0.1)  # m: on the ramp before the beam, as the induction sensors of the thesis
COMMAND_LIMITS, COMMAND_RESOLUTION = (-2.5, 7.5), 0.01  # V
SPEEDS = {"B": np.linspace(0.3, 1.0, 12), "C": np.linspace(0.3, 1.0, 8)}  # m/s
INITIAL_TABLES = {  # V at fractions of the span
    "B": [([0.0, 0.2, 0.9, 1.0], [0.5, 6.8, 6.8, 0.0])],
    "C": [
        ([0.0, 0.1, 0.38, 0.55, 0.75, 1.0], [0.3, 6.8, 6.8, -1.8, -1.8, 0.0]),
        ([0.0, 0.1, 0.38, 0.55, 0.9, 1.0], [0.0, -1.8, -1.8, 6.8, 6.8, 0.0]),
    ],
}
BREAKPOINTS, STEPS = {"B": 31, "C": 41}, {"B": 250, "C": 140}
SAMPLE_RATE = {"B": 200.0, "C": 100.0}  # Hz: enough for a smooth peak
MODES = 3  # of the model in tuning; the studies use those of the rig


def initial_law(rig: str) -> jb.Feedforward:
    """The law that tuning starts from on rig B or C."""
    shares = np.linspace(0.0, 1.0, BREAKPOINTS[rig])
    return jb.Feedforward(
        gates=GATES,
        shares=shares,
        values=[np.interp(shares, *table) for table in INITIAL_TABLES[rig]],
        period=PERIOD,
        lead=LEAD,
        resolution=COMMAND_RESOLUTION,
    )


def tune_law(rig: str, progress: bool = True) -> tuning.TuningResult:
    """Tune the table and its lead for the worst of all training loads on rig B or C."""
    case = with_modes(rigs.load(rig), MODES)
    slowest = float(case.beam.length) / min(SPEEDS[rig])
    case = dataclasses.replace(
        case,
        controller=initial_law(rig),
        run=jb.Run(duration=slowest + 0.15, sample_rate=SAMPLE_RATE[rig]),
    )
    actuators, breakpoints = case.controller.values.shape
    free = {
        f"controller.values.{a}.{k}": COMMAND_LIMITS
        for a in range(actuators)
        for k in range(breakpoints)
    }
    return tuning.tune(
        case,
        free | {"controller.lead": (0.0, 0.1)},
        tuning.LoadCases(training_loads(SPEEDS[rig])),
        tuning.Objective({"shortfall": 1.0}),
        steps=STEPS[rig],
        progress=progress,
    )


if __name__ == "__main__":
    for name in sys.argv[1:]:
        result = tune_law(name)
        print(result)
        jb.save_case(result.case, FOLDER / f"{name}.toml", overwrite=True)
