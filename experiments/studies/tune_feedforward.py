"""How the tuned laws of `experiments.studies.tuned_feedforward` are found: the gradient through the closed loop.

    python -m experiments.studies.tune_feedforward B        # or C; writes experiments/studies/controllers/feedforward/B.toml

On each patch rig one table of commands over the way of the load serves all masses and speeds. It
starts as a trapezium within the limits of the patches, and its knots follow the gradient of the
worst shortfall behind the bound. On the bench the same table is read earlier by the delay.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

import jaxbeam as jb
import tuning
from jaxbeam import rigs

FOLDER = Path(__file__).parent / "controllers" / "feedforward"
PERIOD, LEAD = 0.01, 0.005  # s: of sampling, and half of it to make up for the hold
GATES = (-0.2, -0.1)  # m: on the ramp before the beam, as the induction sensors of the thesis
COMMAND_LIMITS, COMMAND_RESOLUTION = (-2.5, 7.5), 0.01  # V
MASSES = (0.261, 0.509)  # kg
ENTRY_TIME = 0.05  # s
SPEEDS = {"B": np.linspace(0.3, 1.0, 12), "C": np.linspace(0.3, 1.0, 8)}  # m/s
INITIAL_TABLES = {  # V at shares of the way
    "B": [([0.0, 0.2, 0.9, 1.0], [0.5, 6.8, 6.8, 0.0])],
    "C": [
        ([0.0, 0.1, 0.38, 0.55, 0.75, 1.0], [0.3, 6.8, 6.8, -1.8, -1.8, 0.0]),
        ([0.0, 0.1, 0.38, 0.55, 0.9, 1.0], [0.0, -1.8, -1.8, 6.8, 6.8, 0.0]),
    ],
}
BREAKPOINTS, SEARCH_STEPS = {"B": 31, "C": 41}, {"B": 250, "C": 140}
SAMPLE_RATE = {"B": 200.0, "C": 100.0}  # Hz: enough for a peak that is smooth
MODES = 3  # tuned on three modes, to be proven on those of the rig


def initial_law(rig: str) -> jb.Passage:
    """The law that the search starts from on rig B or C."""
    shares = np.linspace(0.0, 1.0, BREAKPOINTS[rig])
    values = [np.interp(shares, *table) for table in INITIAL_TABLES[rig]]
    return jb.Passage(
        gates=GATES,
        shares=shares,
        values=values,
        period=PERIOD,
        lead=LEAD,
        resolution=COMMAND_RESOLUTION,
    )


def training_loads(rig: str) -> tuple[dict[str, float], ...]:
    """The lightest and the heaviest load at all speeds, entering at ticks and between them."""
    return tuple(
        {
            "loads.0.mass": mass,
            "loads.0.speed": float(speed),
            "loads.0.entry_time": ENTRY_TIME + PERIOD * ((2 * i + j) % 4) / 4,
        }
        for i, speed in enumerate(SPEEDS[rig])
        for j, mass in enumerate(MASSES)
    )


def tune_law(rig: str, progress: bool = True) -> tuning.TuningResult:
    """Tune the table and its lead for the worst of all loads on rig B or C."""
    case = rigs.load(rig)
    slowest = float(case.beam.length) / min(SPEEDS[rig])
    case = dataclasses.replace(
        case,
        beam=dataclasses.replace(case.beam, modes=MODES),
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
        tuning.LoadCases(training_loads(rig)),
        tuning.Objective({"shortfall": 1.0}),
        steps=SEARCH_STEPS[rig],
        progress=progress,
    )


if __name__ == "__main__":
    for rig in sys.argv[1:]:
        found = tune_law(rig)
        print(found)
        jb.save_case(found.case, FOLDER / f"{rig}.toml", overwrite=True)
